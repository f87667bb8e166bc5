"""The bench: its file, the parts that it is assembled from, and the loops that run it."""
