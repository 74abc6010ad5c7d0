"""What is computed from the sound of one microphone, and the messages that say it. No I/O."""
