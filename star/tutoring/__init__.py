"""Tutoring: exercises chosen by progress, and prerequisites of skills found from scores alone."""
