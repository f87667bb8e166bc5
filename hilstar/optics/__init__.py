"""Stars through a lens: cameras, PSFs, motion, glass and layers make the light of a frame."""
