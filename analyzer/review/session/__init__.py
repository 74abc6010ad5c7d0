"""A review session: keys, and the marks that they make."""
