"""How the errors of a sample are spread."""

from dataclasses import dataclass

import numpy as np

from hilstar.basics.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class ErrorSpread:
    """Root mean square, 95th percentile and maximum of some errors; None without any."""

    rms: float | None
    p95: float | None
    max: float | None


def error_spread(errors: FloatArray) -> ErrorSpread:
    """The spread of the finite ones of some errors (n,), none of them negative."""
    finite = errors[np.isfinite(errors)]
    if not len(finite):
        return ErrorSpread(None, None, None)
    return ErrorSpread(
        float(np.sqrt(np.mean(finite**2))), float(np.percentile(finite, 95)), float(finite.max())
    )
