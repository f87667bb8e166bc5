"""The window on the monitor; the only user of glfw."""
