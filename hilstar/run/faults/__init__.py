"""Faults on request in a run: who asks for them, what they do to its frames, and how a ledger brings them back."""
