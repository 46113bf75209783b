"""First labels: which point of light is which spot, from one frame and a prior or none."""
