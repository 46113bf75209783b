"""What is done with results: `compare`, `verify`, `show`, `view`."""
