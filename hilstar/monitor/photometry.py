"""Code values and light: a monitor's response, and rounding to the nearest code."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.arrays import Float32Array, FloatArray

Codes = npt.NDArray[np.unsignedinteger[Any]]


def srgb_light(signal: FloatArray) -> FloatArray:
    """Relative light of an sRGB signal, both from 0 to 1 (IEC 61966-2-1)."""
    linear = signal / 12.92
    power = ((np.maximum(signal, 0.04045) + 0.055) / 1.055) ** 2.4
    return np.where(signal <= 0.04045, linear, power)


@dataclass(frozen=True, slots=True)
class Response:
    """What light each code makes, and where one code gives way to the next.

    `light` (2^bits,) is relative to white and rises from 0 to 1. A wanted light from `threshold[k - 1]` up to
    `threshold[k]` gets code k; the thresholds (2^bits - 1,) are the response at the half codes.
    """

    bits: int
    light: FloatArray
    threshold: FloatArray

    @property
    def white(self) -> int:
        """The largest code."""
        return int(2**self.bits - 1)

    def thresholds_e_per_s(self, flux_at_white_e_per_s: float) -> Float32Array:
        """The thresholds in the unit of the linear image, float32 as the renderer compares them."""
        return np.asarray(self.threshold * flux_at_white_e_per_s, dtype=np.float32)


def srgb_response(bits: int) -> Response:
    """The response of an sRGB monitor without black level."""
    white = 2**bits - 1
    codes = np.arange(2**bits, dtype=np.float64)
    return Response(bits, srgb_light(codes / white), srgb_light((codes[:-1] + 0.5) / white))


def code_dtype(bits: int) -> type[np.uint8] | type[np.uint16]:
    """uint8 up to 8 bits, uint16 beyond."""
    return np.uint8 if bits <= 8 else np.uint16


def encode(linear_e_per_s: Float32Array, response: Response, flux_at_white_e_per_s: float) -> Codes:
    """Nearest codes of a linear image, same shape; what is over white becomes white."""
    thresholds = response.thresholds_e_per_s(flux_at_white_e_per_s)
    codes = np.searchsorted(thresholds, linear_e_per_s, side="right")
    return codes.astype(np.uint8) if response.bits <= 8 else codes.astype(np.uint16)
