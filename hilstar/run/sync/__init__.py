"""A tracker's exposures before a screen that refreshes: how the two beat, and a pulse at each frame for its trigger."""
