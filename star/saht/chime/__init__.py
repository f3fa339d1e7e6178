"""CHIME: tasks emerge where a robot finds something that it can control, and models of them are nested."""
