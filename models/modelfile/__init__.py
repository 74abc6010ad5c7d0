"""The model file, its card, and the folder of models of a recorder."""
