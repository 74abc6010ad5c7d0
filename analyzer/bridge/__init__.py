"""Bridge from the log of a recorder to MQTT, alerts, Prometheus and a web page."""
