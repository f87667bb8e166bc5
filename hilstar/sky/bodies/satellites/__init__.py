"""Satellites and debris on two-line elements: where they are seen, how bright, and for how long of an exposure."""
