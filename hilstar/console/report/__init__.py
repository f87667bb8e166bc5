"""A run's report: the operator's page with the whole run in it."""
