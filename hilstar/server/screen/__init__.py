"""The monitor's window in a run: its timing, its photodiode square, and what its operator's keys
change.
"""
