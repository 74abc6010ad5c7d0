"""Live and recorded logs in Foxglove and Lichtblick: the log's bytes over a WebSocket."""
