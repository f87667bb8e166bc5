"""What the brightness models make of a star, a file for each chart."""
