"""Bodies seen by rays, float64: the truth for what the package draws, which shares no code with
it.
"""
