"""The bench: its file, the parts that the file describes, and the frames that they draw."""
