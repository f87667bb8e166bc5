"""For your own tests: two skies compared star by star, so that a golden frame holds on another
driver.
"""

from hilstar.instruments.compare import assert_same_sky, compare

__all__ = ["assert_same_sky", "compare"]
