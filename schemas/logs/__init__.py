"""Logs: their files, what is written into them, messages as columns, a log that grows."""
