"""The lens of one camera from photographs of a board."""
