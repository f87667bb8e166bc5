"""Sprites become a linear image and code values: on the GPU, and in NumPy as the oracle."""
