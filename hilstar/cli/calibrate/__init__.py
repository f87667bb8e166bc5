"""Commands that calibrate a bench."""
