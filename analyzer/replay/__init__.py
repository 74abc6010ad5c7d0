"""Replay of recorded logs through the pipeline."""
