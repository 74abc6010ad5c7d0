"""The model file, its card, and a recorder's folder of models."""
