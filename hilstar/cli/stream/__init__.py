"""Commands about attitude streams and logs."""
