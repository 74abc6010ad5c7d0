"""Messages: definitions, topics, and CDR to arrays and back."""
