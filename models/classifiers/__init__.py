"""Classifiers: the model, its description, and the kinds of classifier."""
