"""What each step of the session does: looked at by eye or camera, and measured."""
