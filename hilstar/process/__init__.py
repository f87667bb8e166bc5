"""The process itself: signals, priority, and a stderr that nobody can hold up."""
