"""Where sound comes from: an array of microphones, and directions in their channels."""
