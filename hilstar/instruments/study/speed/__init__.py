"""How long a frame takes, beside other ways to the same image."""
