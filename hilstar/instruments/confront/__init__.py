"""Photographs of the sky against what hilstar predicts of them."""
