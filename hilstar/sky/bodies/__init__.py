"""Sun, Moon and planets as points of light: where they are seen, how bright, of what colour."""
