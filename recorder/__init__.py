"""The box in the home: capture, features, statistics and the log being written."""
