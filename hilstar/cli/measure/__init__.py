"""Commands that measure what is shown."""
