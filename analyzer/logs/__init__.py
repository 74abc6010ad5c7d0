"""Logs and layers of a home: discovery, contents, time spans and the catalogue."""
