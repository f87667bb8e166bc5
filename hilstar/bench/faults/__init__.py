"""Faults on request: what is wrong in the sky or on the display at a time, for a time."""
