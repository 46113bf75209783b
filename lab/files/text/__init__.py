"""YAML, CSV and JSON text, their fields and columns, and writing a file whole or not at all."""
