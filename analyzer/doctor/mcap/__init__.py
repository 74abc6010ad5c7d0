"""Whether a file is sound MCAP: its records, chunks, indexes and summary."""
