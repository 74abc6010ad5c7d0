"""Feature sets of other systems, added to hearthlog."""
