"""What is tested: the centroider alone, a Python callable, or a command that gets an image and prints a quaternion."""
