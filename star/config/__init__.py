"""What all settings are made of, and those of a run."""
