"""Picture files and videos of all kinds, decoded to grey."""
