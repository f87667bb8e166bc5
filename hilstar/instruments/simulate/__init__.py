"""The digital twin: the virtual tracker, the light of the monitor through its optics, and the
verdict.
"""
