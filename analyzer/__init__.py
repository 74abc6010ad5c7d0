"""Readers of logs and labelled audio: training, evaluation, reports, review."""
