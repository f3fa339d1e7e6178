"""The command `star`."""

from star.cli.command import main

__all__ = ["main"]
