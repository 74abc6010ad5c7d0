"""The log that is being recorded: its files, what the disk refuses of them, and their recovery."""
