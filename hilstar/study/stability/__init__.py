"""Where methods fail: each place, by how much, and what hilstar does there."""
