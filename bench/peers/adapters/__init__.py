"""Other trackers behind one interface, a module each."""
