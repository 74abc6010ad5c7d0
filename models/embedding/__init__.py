"""Embeddings of sound: what a pretrained network gives for a window, as it is logged."""
