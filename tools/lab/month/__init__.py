"""Months of a recorder in hours: its real code on a fast clock, with faults thrown in."""
