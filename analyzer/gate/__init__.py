"""Gate: the changes a model would make in a home, checked for damage before it labels there."""
