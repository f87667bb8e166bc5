"""Basilisk's Vizard stream: protobuf bytes in, the attitude of one spacecraft out."""
