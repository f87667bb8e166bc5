"""First light: one guided, resumable session for the first day on a bench."""
