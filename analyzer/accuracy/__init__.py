"""Accuracy of the labels in a home, estimated from minutes drawn at random."""
