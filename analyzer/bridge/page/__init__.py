"""A page of the home, for the browsers of those who live with the box."""
