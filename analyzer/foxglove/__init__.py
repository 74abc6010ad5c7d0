"""What is heard, and what was, in Foxglove and Lichtblick: the log's bytes over a WebSocket."""
