"""What is heard, for a broker of MQTT and for Home Assistant."""
