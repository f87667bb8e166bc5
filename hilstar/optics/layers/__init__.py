"""Light of one image: a view of the sky, and the layers that each add light to it."""
