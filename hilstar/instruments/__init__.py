"""What is measured with a display; the server never imports it."""
