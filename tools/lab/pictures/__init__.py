"""The pictures of docs, made of a simulated home."""
