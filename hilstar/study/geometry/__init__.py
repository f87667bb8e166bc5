"""What a geometric calibration reaches, against rays traced through a real lens."""
