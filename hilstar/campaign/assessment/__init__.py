"""A run assessed: its ledger and the tracker's telemetry in, the error budget on one page out."""
