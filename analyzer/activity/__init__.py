"""Activity of a home: segments, events, coverage, days, routine and accuracy, defined once."""
