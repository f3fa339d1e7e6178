"""Runs: folder, journal, checkpoints, signals and the loop around the epochs of an experiment."""
