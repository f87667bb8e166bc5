"""Links that a process of their own reads, so that no stamp waits for Python's lock."""
