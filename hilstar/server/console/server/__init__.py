"""The page's own process: reads a run's shared memory and serves it to browsers and monitoring,
without OpenGL.
"""
