"""Bytes of files: on this machine or in a store, regular, within limits."""
