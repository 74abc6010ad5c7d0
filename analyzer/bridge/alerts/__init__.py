"""Alerts: evaluation of rules on the log, and delivery of notifications."""
