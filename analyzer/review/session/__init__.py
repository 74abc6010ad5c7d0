"""A review: what keys do, and the marks they make."""
