"""The virtual star tracker: from expected electrons to code values, and from code values to star
positions.
"""
