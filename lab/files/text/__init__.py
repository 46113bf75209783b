"""YAML, CSV and JSON text, field types and checks, error texts, and atomic writing."""
