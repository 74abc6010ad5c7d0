"""Gate: checks of the changes by a model in a home, before the model labels there."""
