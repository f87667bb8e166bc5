"""SPICE C-kernels: the file is checked before SPICE sees it, and SPICE alone says what its attitudes are."""
