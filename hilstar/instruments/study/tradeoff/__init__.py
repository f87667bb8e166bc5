"""For each step of the chain: every method against the exact one, error against time."""
