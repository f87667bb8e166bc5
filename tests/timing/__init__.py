"""Tests that claim a time: they run one at a time, after all others."""
