"""hilstar beside independent programs, each run for real: what `tools/beside.py` and
tests/authority/test_beside.py run.

A module a program has `run(folder)`, which gives the steps of `steps.py`: a difference as it is
first seen, then with one cause after the other taken out, to what is left.
"""
