"""The version, which logs carry: apart from the public names, on which nothing of ours stands."""

__version__ = "0.2.0"
