"""Undamaged records and losses of a damaged file."""
