"""Lockstep: a frame for each attitude, at whatever speed the simulation has; one file for each kind of sender."""
