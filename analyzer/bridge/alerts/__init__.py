"""Alerts: rules that are evaluated from the log, and delivery of their notifications."""
