"""Packets on the wire: their bytes, the sockets and serial lines that carry them, and the keys
that guard them.
"""
