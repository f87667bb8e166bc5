"""Attitudes to send, serial lines to send them over, and ZeroMQ by hand."""
