"""Attitude logs: one file a format, and how their samples join."""
