"""hilstar as a service of this machine."""
