"""This process and those around it: how it ends, when it is scheduled, and what it runs."""
