"""The bridge: sounds of a home by MQTT, alerts, Prometheus and a page, from its log."""
