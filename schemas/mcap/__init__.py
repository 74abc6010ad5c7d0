"""MCAP: records, what a file consists of, messages of many chunks, and the way back."""
