"""Export, merging and cutting of logs."""
