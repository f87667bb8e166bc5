"""The attitude: quaternions, packets, links, logs and the timeline that joins them."""
