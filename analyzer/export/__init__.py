"""Logs in the formats of others."""
