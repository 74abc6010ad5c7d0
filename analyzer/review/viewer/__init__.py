"""Rerun viewer; only this package uses Rerun's API, much of which is unstable between releases."""
