"""What is whole in a damaged file, and what was lost."""
