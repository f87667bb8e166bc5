"""Logs of PX4 (ULog): what is whole of a file, its topics as arrays, and the vehicle's attitude among the stars."""
