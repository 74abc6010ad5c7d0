"""A feature set, a kind of classifier and a way to learn, added to hearthlog."""
