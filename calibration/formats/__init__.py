"""Other programs' camera files: text or parsed YAML to camera models and back. Nothing that is read is executed."""
