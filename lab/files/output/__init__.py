"""Result folders on disk: lock, unfinished parts, replacement, and the saved traceback of an unforeseen error."""
