"""A run: frames paced, drawn and recorded, from a live stream, in lockstep, or from a log."""
