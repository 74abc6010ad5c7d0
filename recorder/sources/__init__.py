"""Sound sources: audio files and microphones."""
