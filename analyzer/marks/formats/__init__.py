"""Label file formats of other programs, one module each, read and written as marks."""
