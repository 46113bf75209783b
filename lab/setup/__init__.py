"""Before the first recording: `init`, `plan`, `doctor`, `schema`."""
