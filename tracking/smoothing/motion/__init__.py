"""Most probable motion of a whole run given its labelled spots: fixed-interval smoother and process noise."""
