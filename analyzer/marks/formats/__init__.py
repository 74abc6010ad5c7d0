"""Label files of other programs, read as marks and written from marks: a module for each format."""
