"""MCAP records, file structure, batch reading and writing."""
