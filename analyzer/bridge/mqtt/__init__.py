"""Output to an MQTT broker and Home Assistant."""
