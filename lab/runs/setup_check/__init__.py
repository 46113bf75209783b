"""The check of the set-up: whether a usual mistake explains a recording better than the files do."""
