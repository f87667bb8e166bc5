"""The scene: stars through a camera become sprites."""
