"""All files that the program reads and writes."""
