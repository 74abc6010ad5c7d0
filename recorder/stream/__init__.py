"""Processing of one microphone's sound, and the resulting messages. No I/O."""
