"""Marks of a reviewer: their layers, label files of other programs, enrolled sounds."""
