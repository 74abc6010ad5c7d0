"""Clips: choosing, writing and deleting sound that is kept."""
