"""Campaigns: many cases of a bench, over every core and machine, and what the tracker's errors are over all of them."""
