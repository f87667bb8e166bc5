"""Geometric calibration: dots on the monitor, their places in the tracker's image, and the lens between them."""
