"""Multiple hypotheses about the vehicle's state: branching over labels and manoeuvres, exact updates, pruning."""
