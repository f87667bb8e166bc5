"""Attitudes in: packets and links, the clock of their sender, logs, and the timeline that joins
them.
"""
