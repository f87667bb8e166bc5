"""X servers, what runs on them, and what a user does to a window."""
