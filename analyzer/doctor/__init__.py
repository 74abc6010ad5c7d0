"""Checks of logs against the MCAP specification, docs/log.md and neighbouring logs."""
