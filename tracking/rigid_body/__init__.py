"""The rigid tracker: one multiple-hypothesis filter of the vehicle, which carries all spots."""
