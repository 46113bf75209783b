"""Commands of the related measurements and of the published experiments."""
