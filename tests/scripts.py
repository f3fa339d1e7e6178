"""The scripts of the project, as modules."""

import importlib


def load(name):
    """The script `name` below scripts/, such as checks/physics."""
    return importlib.import_module(f"scripts.{name.replace('/', '.')}")
