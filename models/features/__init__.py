"""Feature sets: the values of each frame of sound, and the inputs of classifiers."""
