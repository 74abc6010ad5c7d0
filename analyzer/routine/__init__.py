"""Routines of a home over its weeks, and the anomaly of a day."""
