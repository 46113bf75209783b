"""Parts of a report that need none of the tables: the model check, and the text on the methods."""
