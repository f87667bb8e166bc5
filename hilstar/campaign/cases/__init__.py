"""One case: its bench, attitude and noise by its number alone, its exposures, and the row that it becomes."""
