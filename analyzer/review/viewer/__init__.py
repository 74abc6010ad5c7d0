"""Rerun: the only package that knows it, for much of it is unstable and changes by the release."""
