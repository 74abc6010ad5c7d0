"""What to review next: uncertain, novel, where two labellings differ."""
