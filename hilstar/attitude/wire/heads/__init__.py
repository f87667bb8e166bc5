"""One source for several heads: what arrives is handed on to each head's process, with the time of its arrival."""
