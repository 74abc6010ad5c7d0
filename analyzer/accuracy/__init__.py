"""Accuracy of the labels in a home, by minutes drawn at random."""
