"""Output to a broker of MQTT, and to Home Assistant."""
