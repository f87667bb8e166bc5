"""The process itself: signals, priority, and writing to stderr without waiting."""
