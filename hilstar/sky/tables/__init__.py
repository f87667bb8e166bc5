"""A user's own table of stars: read, converted to V and colours, joined with Hipparcos, and kept for the next time."""
