"""Pictures of a run with what was found drawn over them: for the report, `beampose show` and the overlay video."""
