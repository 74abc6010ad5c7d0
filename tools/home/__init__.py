"""A simulated home, to try hearthlog without a microphone."""
