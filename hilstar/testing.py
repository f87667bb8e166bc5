"""For your own tests: two skies compared star by star, so that a golden frame holds on another
driver.

>>> with hilstar.load("bench.toml") as bench:
...     frame = bench.frame([0.6987226, 0.7135120, -0.0370377, 0.0362700])
>>> hilstar.testing.compare(frame, frame.linear).same
True
"""

from hilstar.instruments.compare import assert_same_sky, compare

__all__ = ["assert_same_sky", "compare"]
