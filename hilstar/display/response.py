"""Levels and light: a monitor's response, and rounding to the nearest level."""

from dataclasses import dataclass
from itertools import product
from typing import Any, NewType

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import Float32Array, FloatArray
from hilstar.basics.errors import InputError

# What the monitor is given: (height, width), or (height, width, 3) where the primaries differ.
Codes = npt.NDArray[np.unsignedinteger[Any]]
# Indices into a response's levels (height, width). A level is a code only without bit stealing.
Levels = NewType("Levels", np.ndarray[Any, np.dtype[np.unsignedinteger[Any]]])
Weights = tuple[float, float, float]

# Lights closer than this to each other (relative) are one level: a step of the renderer's float32
# is 6e-8.
SAME_LIGHT = 1e-6
MAX_LEVELS = 2**16  # the range of uint16
TRIPLES = 7  # grey k and the six mixed triples above it


def srgb_light(signal: FloatArray) -> FloatArray:
    """Relative light of an sRGB signal, both from 0 to 1 (IEC 61966-2-1)."""
    linear = signal / 12.92
    power = ((np.maximum(signal, 0.04045) + 0.055) / 1.055) ** 2.4
    return np.where(signal <= 0.04045, linear, power)


@dataclass(frozen=True, slots=True)
class Response:
    """The light of each level, and the thresholds between levels.

    A level is a code value or, with bit stealing, a triple of codes. `light` (levels,) is the light
    above the black level, relative to white above black: 0 at level 0, strictly rising, 1 at white.
    Light from `threshold[k - 1]` up to `threshold[k]` is shown by level k; there are (levels - 1,)
    of them. `black` is the light of level 0 in the same unit. `rgb` (levels, 3) holds the codes of
    each level; where it is None, level k is code k in all three channels.
    """

    bits: int
    light: FloatArray
    threshold: FloatArray
    black: float = 0.0
    rgb: npt.NDArray[np.uint16] | None = None

    @property
    def white(self) -> int:
        """The largest level."""
        return len(self.light) - 1

    @property
    def half_step(self) -> float:
        """Half of the smallest step of light above black: less than that is nearer to nothing."""
        return float(self.light[1]) / 2

    def thresholds_e_per_s(self, flux_at_white_e_per_s: float) -> Float32Array:
        """The thresholds in the unit of the linear image, float32 as the renderer compares them."""
        return np.asarray(self.threshold * flux_at_white_e_per_s, dtype=np.float32)


def srgb_response(bits: int) -> Response:
    """The response of an sRGB monitor without black level; its thresholds are the light at the
    half codes.
    """
    codes, half_codes = _signals(bits)
    return Response(bits, srgb_light(codes), srgb_light(half_codes))


def gamma_response(bits: int, gamma: float = 2.2) -> Response:
    """The response of a monitor with a plain power law, without black level; its thresholds are
    the light at the half codes.
    """
    codes, half_codes = _signals(bits)
    return Response(bits, codes**gamma, half_codes**gamma)


def _signals(bits: int) -> tuple[FloatArray, FloatArray]:
    """The signals, 0 to 1, of all codes (2^bits,), and midway between them (2^bits - 1,)."""
    white = 2**bits - 1
    codes = np.arange(2**bits, dtype=np.float64)
    half_codes = codes[:-1] + 0.5
    return codes / white, half_codes / white


def table_response(bits: int, light: FloatArray, black: float = 0.0) -> Response:
    """The response of a table of light (2^bits,), 0 to 1 above black; its thresholds lie midway
    between two lights.
    """
    return Response(bits, light, _midway(light), black)


def mixed_response(
    channels: tuple[Response, Response, Response], weights: Weights, black: float = 0.0
) -> Response:
    """The grey response of three channels, each weighted as the tracker sees its primary."""
    share = np.asarray(weights) / np.sum(weights)
    lights = np.stack([channel.light for channel in channels])
    light = share @ lights
    return table_response(channels[0].bits, light / light[-1], black)


def bit_stealing_response(
    channels: tuple[Response, Response, Response], weights: Weights, black: float = 0.0
) -> Response:
    """Levels between the greys: the six triples of codes k and k + 1 between grey k and grey k + 1,
    by rising light.

    `weights` are the primaries' shares of white as the tracker sees them, any scale. Triples of the
    same light are one level, so 8 bits have 255 * 7 + 1 levels at most (Tyler 1997, Spatial Vision
    10, 369). Raises InputError beyond 13 bits.
    """
    bits = channels[0].bits
    if (2**bits - 1) * TRIPLES + 1 > MAX_LEVELS:
        raise InputError(
            f"bit stealing makes more than {MAX_LEVELS} levels of {bits} bits; use it with at most"
            " 13 bits"
        )
    share = np.asarray(weights, dtype=np.float64) / np.sum(weights)
    # (0, 0, 0) first; (1, 1, 1) is the next grey
    white = 2**bits - 1
    steps = np.array(list(product((0, 1), repeat=3)))[:TRIPLES]
    greys = np.arange(white)[:, None, None]
    triples = (greys + steps).reshape(-1, 3)
    rgb = np.concatenate([triples, np.full((1, 3), white)])
    lights = [channel.light[codes] for channel, codes in zip(channels, rgb.T, strict=True)]
    light = np.stack(lights, axis=1) @ share
    order = np.argsort(light, kind="stable")
    rgb = rgb[order]
    light = light[order]
    is_grey = (rgb == rgb[:, :1]).all(axis=1)
    places = [0]
    for place in range(1, len(light)):
        if light[place] > light[places[-1]] * (1 + SAME_LIGHT):
            places.append(place)
        elif is_grey[place]:  # of equal lights it is the level, whose primaries are alike
            places[-1] = place
    light = light[places]
    light = light / light[-1]
    return Response(bits, light, _midway(light), black, rgb[places].astype(np.uint16))


def _midway(light: FloatArray) -> FloatArray:
    """The middles (n - 1,) between lights (n,)."""
    return (light[:-1] + light[1:]) / 2


def code_dtype(bits: int) -> type[np.uint8] | type[np.uint16]:
    """uint8 up to 8 bits, uint16 beyond."""
    return np.uint8 if bits <= 8 else np.uint16


def encode(
    linear_e_per_s: Float32Array, response: Response, flux_at_white_e_per_s: float
) -> Levels:
    """Nearest levels of a linear image, same shape, uint8 up to 256 levels; light over white
    becomes white.
    """
    thresholds = response.thresholds_e_per_s(flux_at_white_e_per_s)
    levels = np.searchsorted(thresholds, linear_e_per_s, side="right")
    return Levels(levels.astype(np.uint8 if len(response.light) <= 256 else np.uint16))
