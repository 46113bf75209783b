"""One target in the pictures of one camera (`track`: point, circle, drogue) or of two (`stereo`)."""
