"""Review of logs: their timeline in a viewer, and marks made there."""
