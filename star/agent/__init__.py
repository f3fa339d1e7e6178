"""STAR itself: three levels, the clocks on which they act and learn, and its own state."""
