"""The codes of warnings, verdict reasons, findings and errors, and what each means: `beampose explain`."""
