"""Units: the constants and conversions that the rooms share, each of them once."""

import math
from typing import TYPE_CHECKING, overload

if TYPE_CHECKING:
    from hilstar.arrays import FloatArray

NS_PER_US = 1_000
NS_PER_MS = 1_000_000
NS_PER_S = 1_000_000_000
ARCSEC_PER_RAD = math.degrees(1.0) * 3600.0
MAD_TO_SIGMA = 1.482602218505602  # from the median absolute deviation of a normal distribution: 1 / its upper quartile
ERROR_OF_MEDIAN = math.sqrt(math.pi / 2)  # in those of the mean, for normal errors
LIGHT_M_S = 299_792_458.0  # SI, exact
LIGHT_KM_S = LIGHT_M_S / 1000.0
MAX_SPEED_KM_S = 10_000.0  # of an observer: a thirtieth of that of light
MAG_PER_RELATIVE = 2.5 / math.log(10)  # a small relative error of a flux, in magnitudes


@overload
def flux_ratio(mag: float) -> float: ...
@overload
def flux_ratio(mag: "FloatArray") -> "FloatArray": ...
def flux_ratio(mag: "float | FloatArray") -> "float | FloatArray":
    """The flux of a star of magnitude `mag` relative to one of magnitude 0 (Pogson 1856)."""
    return 10 ** (-0.4 * mag)


@overload
def magnitude(ratio: float) -> float: ...
@overload
def magnitude(ratio: "FloatArray") -> "FloatArray": ...
def magnitude(ratio: "float | FloatArray") -> "float | FloatArray":
    """The magnitude of a flux relative to that of magnitude 0; infinite for no flux."""
    if hasattr(ratio, "shape"):
        import numpy as np  # 0.1 s, which Tab and --help do not need

        with np.errstate(divide="ignore"):
            return np.asarray(-2.5 * np.log10(ratio))
    return -2.5 * math.log10(ratio) if ratio > 0 else math.inf


# OpenGL versions to ask for, newest first: NVIDIA's driver gives the version that is asked for, and no newer one.
GL_VERSIONS = ((4, 6), (4, 5), (4, 3), (3, 3))
