"""What a model would change in a home before it labels there, and whether that is damage."""
