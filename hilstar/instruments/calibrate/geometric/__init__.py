"""Geometric calibration: the lens between monitor and tracker, from dots on the monitor and
their centroids.
"""
