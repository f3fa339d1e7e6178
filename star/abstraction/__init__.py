"""The regions of the abstract space: what they are, what is known of them, and how they are cut."""
