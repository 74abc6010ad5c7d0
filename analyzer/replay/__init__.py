"""Recorded logs once more through the pipeline."""
