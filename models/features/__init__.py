"""Feature sets: what is computed from each frame of sound, and what classifiers look at."""
