"""Datagrams: who may send them, when they arrived, and the link made of them."""
