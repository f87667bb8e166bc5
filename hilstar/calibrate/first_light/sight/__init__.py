"""Where a session's images come from: a command, a person, or the twin; and the display that shows its patterns."""
