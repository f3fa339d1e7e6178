"""The parts of all settings, and the settings of a run."""
