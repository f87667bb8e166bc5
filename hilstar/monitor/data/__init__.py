"""The example of a calibration, and the script that makes it."""
