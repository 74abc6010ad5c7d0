"""Recorder: capture, features, statistics and the live log."""
