"""A simulated home, for those who have no microphone at hand."""
