"""Logs as a timeline: at the resolution of a screen, or as they are being written."""
