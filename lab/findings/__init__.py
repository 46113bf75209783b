"""Findings of all commands: one scale of severity, one type, and one table of codes with their texts."""
