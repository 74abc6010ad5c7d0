"""Two labellings of the same logs: where they differ, and what to review next."""
