"""Clips: which sound may be kept, keeping it, forgetting it."""
