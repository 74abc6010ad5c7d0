"""Training: labelled sound, ways to learn, and what becomes of them."""
