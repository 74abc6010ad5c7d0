"""Downloads that a user asks for, of files whose digest is known."""
