"""Classifier inference, segments and the model file, on numpy alone."""
