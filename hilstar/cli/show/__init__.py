"""Commands that show stars."""
