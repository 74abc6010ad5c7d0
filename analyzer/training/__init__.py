"""Training: labelled sound, methods to learn from it, transitions and scores."""
