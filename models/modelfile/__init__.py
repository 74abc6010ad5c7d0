"""The model file, its card, and the folder of models that a recorder takes its own from."""
