"""Marks: a reviewer's corrections, their layers, and files of labels."""
