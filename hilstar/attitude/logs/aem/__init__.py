"""CCSDS Attitude Ephemeris Messages, read as KVN or XML and written as either."""
