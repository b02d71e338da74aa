"""From a height field to a spectrum and its file, by either theory; recipes and their cache."""
