"""Camera files of other programs: text or parsed YAML to camera models and back. File contents are never executed."""
