"""The alignment of a tracker that gives only quaternions: commanded attitudes against reported ones."""
