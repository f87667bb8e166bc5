"""The ledger of a run: its file and its records, and the figures that a report computes from it."""
