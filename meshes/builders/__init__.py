"""Bodies by their name: builders with parameters, one a file."""
