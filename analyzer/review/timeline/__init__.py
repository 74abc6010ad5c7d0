"""What some logs hold, at the resolution of a screen: what a timeline shows."""
