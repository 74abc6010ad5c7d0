"""Web page of the home, for the people who live there."""
