"""The smoothing pass: labels and motion of a whole run, given all of its frames."""
