"""`[attitude]`: where attitudes come from, and by which road."""
