"""The recorder as a service of systemd."""
