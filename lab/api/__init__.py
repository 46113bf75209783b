"""The program from Python and notebooks: results as pandas frames, detection and tracking of arrays."""
