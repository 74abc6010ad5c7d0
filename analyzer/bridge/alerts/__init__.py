"""Alerts: rules that are evaluated from the log, and the ways on which they are told."""
