"""The sender of test streams, and the faults that it can inject."""
