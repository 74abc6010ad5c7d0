"""Log files, writers, columnar reading, and following of growing logs."""
