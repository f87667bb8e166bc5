"""The process of the page and of SCPI: reads a run's shared memory and serves it to browsers,
monitoring and test stands, without OpenGL.
"""
