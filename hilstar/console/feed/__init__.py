"""A run's own part in the operator's page: it writes into memory that the page's process reads, and keeps it alive."""
