"""Sweeps: many trials of one experiment."""
