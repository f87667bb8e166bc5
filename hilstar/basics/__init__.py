"""What every room may know: units, rotation, errors, files, tables, processes, charts and pages."""
