"""Classifiers of other systems: trees, neighbours, perceptrons, one-class machines."""
