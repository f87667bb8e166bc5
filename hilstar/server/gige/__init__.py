"""A GigE Vision camera: its registers and description, its two protocols without I/O, and its
sockets.
"""
