"""What a star tracker answers while it runs: its bytes, decoded and read in a process apart."""
