"""The sender's clock against the host's, and the attitude at any moment."""
