"""A star tracker's answers during a run: a separate process reads and decodes its bytes, and the
server compares each answer with the sky that was lit.
"""
