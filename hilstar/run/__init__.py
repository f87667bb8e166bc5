"""A run: frames paced, drawn and recorded, live, in lockstep or of a log."""
