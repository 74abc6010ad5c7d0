"""Discovery of recurring sounds and voices in a home."""
