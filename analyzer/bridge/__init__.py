"""What a home is told of its sounds: by MQTT, alerts, Prometheus and a page, all from the log."""
