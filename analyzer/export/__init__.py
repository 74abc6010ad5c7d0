"""Logs in other formats, merged or cut."""
