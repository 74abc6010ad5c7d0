"""The routines of a home, learned from its own weeks, and how unlike them a day was."""
