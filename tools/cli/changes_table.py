"""What another labelling changes in a home, in lines."""

from typing import TYPE_CHECKING

from hearthlog.tools.cli.table import print_table

if TYPE_CHECKING:
    from hearthlog.analyzer.gate.paired_labels import LabelChanges

_SHOWN = 8  # changes


def print_changes(changes: "LabelChanges", before: str, after: str) -> None:
    """Print the longest changes, and the minutes of each class."""
    from hearthlog.analyzer.gate.paired_labels import time_words

    for change in changes.pairs()[:_SHOWN]:
        print(f"  {change}")
    rows = [
        (name, time_words(first), time_words(second))
        for name, first, second in zip(changes.classes, changes.before, changes.after, strict=True)
        if first or second
    ]
    print()
    print_table((changes.each.strip() or "in all", before, after), rows)
