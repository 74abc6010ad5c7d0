"""Smoothing of probabilities, and segments."""
