"""Embeddings of sound: the output of a pretrained network for a window, as logged."""
