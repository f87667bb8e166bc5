"""The whole chain: each combination of its choices, the error that a tracker measures against
the time of a frame.
"""
