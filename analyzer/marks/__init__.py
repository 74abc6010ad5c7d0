"""Reviewer marks: mark layers, label files of other programs and enrolled sounds."""
