"""How good a model, or a labelling, is: scores, events, references, pictures."""
