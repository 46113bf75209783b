"""The index of a batch: index.html with a row per run, thumbnails, and trends over the recording date."""
