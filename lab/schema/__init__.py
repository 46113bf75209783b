"""`beampose schema`: JSON schemas of the YAML files, for editors."""
