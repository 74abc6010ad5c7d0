"""Message definitions, topics, and conversion between CDR and arrays."""
