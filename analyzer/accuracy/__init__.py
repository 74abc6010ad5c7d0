"""How right the labels are in this home, measured by minutes that were drawn at random."""
