"""Listens to a home for years: sound to features and labels every 50 ms, in MCAP logs."""

__version__ = "0.2.0"
