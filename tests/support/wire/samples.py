"""Attitudes to send."""

from __future__ import annotations

import numpy as np

from hilstar.attitude.wire.packet import AttitudeSample

Q = np.array([0.5, 0.5, -0.5, 0.5])


def sample(k: int) -> AttitudeSample:
    """The k-th attitude of a sender: 1 ms after the last, and turning faster."""
    return AttitudeSample(1_000_000 * k, Q, np.array([0.0, k, -k]), k)
