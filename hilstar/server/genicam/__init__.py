"""Cameras by GenICam (GigE Vision, USB3 Vision) through Aravis: listed, set, and their images
taken.
"""
