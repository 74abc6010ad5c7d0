"""The version, also recorded in logs; separate from the public names, which our code avoids."""

__version__ = "0.3.0"
