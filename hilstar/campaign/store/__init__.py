"""A campaign's directory: whose it is, the journal of rows as they come, and the sorted Parquet file at the end."""
