"""A simulated home, to try everything without a microphone."""
