"""Several heads beside one source: a process a head, started again where it ends or stalls."""
