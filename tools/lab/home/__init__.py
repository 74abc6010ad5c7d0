"""A simulated home for measurements: its person, other microphones, and copies of its logs."""
