"""The spread of errors."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.basics.error_spread import ErrorSpread, error_spread


def test_what_is_not_finite_has_no_part_in_the_spread():
    assert error_spread(np.array([np.nan, np.inf])) == ErrorSpread(None, None, None)
    assert error_spread(np.array([3.0, 4.0, np.inf])) == ErrorSpread(
        pytest.approx(np.sqrt(12.5)), pytest.approx(3.95), 4.0
    )
