"""Labelling models: loading, watching, and replacement during recording."""
