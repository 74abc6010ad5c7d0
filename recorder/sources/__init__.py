"""Where sound comes from: audio files and microphones."""
