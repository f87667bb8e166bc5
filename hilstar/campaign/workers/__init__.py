"""Where cases are run: what a worker is sent and has to be, the pool of this machine, and a cluster's scheduler."""
