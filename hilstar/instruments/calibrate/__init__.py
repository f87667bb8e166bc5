"""Calibration: measurements in, files that a bench uses out."""
