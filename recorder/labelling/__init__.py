"""The models that label: loaded, watched, and replaced while sound is recorded."""
