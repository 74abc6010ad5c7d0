"""Marks in files of others: Audacity, CSV, Raven, ELAN, Label Studio, RTTM."""

from hearthlog.analyzer.marks.formats.label_files import (
    SUFFIXES,
    read_labels,
    read_lines,
    write_labels,
)
from hearthlog.analyzer.marks.merge_marks import new_marks

__all__ = ["SUFFIXES", "new_marks", "read_labels", "read_lines", "write_labels"]
