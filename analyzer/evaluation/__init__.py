"""Evaluation: scores of models and labellings against references, and their plots."""
