"""Logs of a home and their layers: which there are, what they say, of which time."""
