"""Campaigns: many cases of a bench, run over every core and machine, into one table with its
error budget.
"""
