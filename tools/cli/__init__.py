"""The command `hearthlog`, one module a verb."""
