"""Weekly routines of a home, and the anomaly of a day."""
