"""What `verify --propose` would change in a bench file, and what it says of it."""
