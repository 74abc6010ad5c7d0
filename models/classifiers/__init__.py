"""Classifiers: what a model says of itself, kinds of models, and the one that is ours."""
