"""The example of a calibration, the blue-noise mask, and the scripts that make them."""
