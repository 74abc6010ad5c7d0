"""The recorder as a systemd service."""
