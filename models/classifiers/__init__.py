"""Classifiers: what a model says of itself, and kinds of models."""
