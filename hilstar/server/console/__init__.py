"""The operator's view of a run: the page in a browser, SCPI, the terminal, and the report."""
