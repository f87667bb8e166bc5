"""Attitudes, angles, rates and times as a caller of the Python API has them: numbers in stated
units, SciPy's rotations, Astropy's coordinates and quantities.

SciPy and Astropy are known by the module of a value's type: neither is imported for plain numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, shortened
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.basics.units import NS_PER_S

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from astropy.units import Quantity
    from scipy.spatial.transform import Rotation

    Attitude = Sequence[float] | FloatArray | Rotation | SkyCoord
    Rate = Sequence[float] | FloatArray | Quantity
    Angle = float | Quantity
    Time = int | Quantity

FOUR_NUMBERS = (
    "write a unit quaternion w, x, y, z, a SciPy Rotation, or an Astropy SkyCoord (roll_deg beside"
    " it)"
)
THREE_RATES = (
    "write three numbers x, y, z in rad/s, or an Astropy quantity such as [0, 0, 1] * u.deg / u.s"
)
FROM_RADEC = "hilstar.rotation.from_radec_roll_deg(ra, dec, roll) makes one of angles in degrees"
NO_ROLL = "roll_deg: is for a SkyCoord, and this attitude has its own roll; leave it out"


def quaternion_of(attitude: Any, roll_deg: Any = None) -> FloatArray:
    """The four numbers of an attitude, q_icrs_to_cam (w, x, y, z), float64; their norm is not
    checked.

    A SciPy Rotation turns ICRS components into camera components: `rotation.apply(v_icrs)` is
    v_cam. A SkyCoord is the boresight, with `roll_deg`, 0 by default, a number or a quantity.
    Raises InputError for anything else.
    """
    if is_place(attitude):
        return _of_boresight(attitude, roll_deg)
    if roll_deg is not None:
        raise InputError(NO_ROLL)
    if type(attitude).__module__.startswith("scipy.spatial"):
        scalar_last = np.asarray(attitude.as_quat(), dtype=np.float64)
        if scalar_last.shape != (4,):
            raise InputError(
                f"Rotation: holds {len(scalar_last)} rotations; give one of them, rotation[0]"
            )
        return scalar_last[[3, 0, 1, 2]]
    array = _plain(attitude, "attitude", "1", FOUR_NUMBERS)
    if array.shape == (3,):
        raise InputError(f"attitude of 3 numbers: {FOUR_NUMBERS}; {FROM_RADEC}")
    if array.shape == ():
        raise InputError(f"attitude {shortened(repr(attitude))}: {FOUR_NUMBERS}; {FROM_RADEC}")
    if array.shape != (4,):
        raise InputError(f"attitude of shape {array.shape}: {FOUR_NUMBERS}")
    return array


def is_place(attitude: object) -> bool:
    """Whether an attitude is a place of Astropy, such as a SkyCoord, which has no roll."""
    return type(attitude).__module__.startswith("astropy.coordinates")


def quaternions_of(attitudes: Any, name: str) -> FloatArray:
    """Quaternions (..., 4), scalar first, of numbers or of a SciPy Rotation; their norms are not
    checked. Raises InputError.
    """
    if type(attitudes).__module__.startswith("scipy.spatial"):
        scalar_last = np.asarray(attitudes.as_quat(), dtype=np.float64)
        return scalar_last[..., [3, 0, 1, 2]]
    return numbers_of(attitudes, name, (..., 4), "1", "of unit quaternions, or a Rotation")


def numbers_of(values: Any, name: str, axes: tuple[Any, ...], unit: str, what: str) -> FloatArray:
    """Numbers in a unit, float64, of an array or an Astropy quantity. Raises InputError, which says
    `what` they are of.

    `axes` is the shape: a length, "n" for any, and a leading `...` for any axes before.
    """
    words = ["..." if length is ... else str(length) for length in axes]
    form = f"write an array ({', '.join(words)}) {what}"
    array = _plain(values, name, unit, form)
    last = axes[1:] if axes[:1] == (...,) else axes
    has_axes = array.ndim == len(axes) if last is axes else array.ndim >= len(last)
    seen = array.shape[array.ndim - len(last) :]
    if not has_axes or any(a not in ("n", b) for a, b in zip(last, seen, strict=True)):
        raise InputError(f"{name} of shape {array.shape}: {form}")
    return array


def path_of(path: Any, name: str) -> Path:
    """A path of a text or a path. Raises InputError."""
    if not isinstance(path, (str, Path)):
        raise InputError(f"{name} {shortened(repr(path))}: write the path of a file")
    return Path(path)


def rate_of(rate: Any, name: str = "rate_cam_rad_s") -> FloatArray:
    """An angular rate (3,), camera components, rad/s, of numbers in rad/s or an Astropy quantity.
    Raises InputError.
    """
    array = _plain(rate, name, "rad/s", THREE_RATES)
    if array.shape != (3,):
        raise InputError(f"{name} of shape {array.shape}: {THREE_RATES}")
    if not np.isfinite(array).all():
        raise InputError(f"{name} {array.tolist()}: is not finite; {THREE_RATES}")
    return array


def angle_deg_of(angle: Any, name: str) -> float:
    """An angle, degrees, of a number in degrees or an Astropy quantity. Raises InputError."""
    return _scalar(angle, name, "deg", "write a number of degrees, or an Astropy quantity")


def seconds_of(duration: Any, name: str) -> float:
    """A time span, seconds, of a number of them or an Astropy quantity. Raises InputError."""
    return _scalar(duration, name, "s", "write a number of seconds, or an Astropy quantity")


def share_of(share: Any, name: str) -> float:
    """A plain number, of a number or a quantity without unit. Raises InputError."""
    return _scalar(share, name, "1", "write a number")


def whole_of(number: Any, name: str, minimum: int = 0, maximum: int | None = None) -> int:
    """A whole number from `minimum` to `maximum`, if there is one. Raises InputError."""
    is_whole = isinstance(number, (int, np.integer)) and not isinstance(number, bool)
    if not is_whole or number < minimum or (maximum is not None and number > maximum):
        limits = f"from {minimum} on" if maximum is None else f"from {minimum} to {maximum}"
        raise InputError(f"{name} {shortened(repr(number))}: write a whole number {limits}")
    return int(number)


def t_ns_of(moment: Any, name: str = "t_ns") -> int:
    """A time, integer nanoseconds, of a number of them or an Astropy quantity. Raises
    InputError.
    """
    form = "write whole nanoseconds, or an Astropy quantity such as 2 * u.s"
    if _is_quantity(moment):
        return round(_scalar(moment, name, "s", form) * NS_PER_S)
    if isinstance(moment, (bool, np.bool_)) or not isinstance(moment, (int, np.integer)):
        raise InputError(f"{name} {shortened(repr(moment))}: {form}")
    return int(moment)


def _of_boresight(coordinate: Any, roll_deg: Any) -> FloatArray:
    from astropy.coordinates import ConvertError, SkyCoord

    if not isinstance(coordinate, SkyCoord):
        try:
            coordinate = SkyCoord(coordinate)
        except (TypeError, ValueError) as error:
            raise InputError(f"{shortened(repr(coordinate))}: {FOUR_NUMBERS}") from error
    if not coordinate.isscalar:
        raise InputError(f"SkyCoord: holds {coordinate.size} places; give one, the boresight")
    try:
        icrs = coordinate.icrs
    # Without an observer or a time Astropy fails within: AttributeError.
    except (AttributeError, ConvertError, ValueError) as error:
        raise InputError(
            f"SkyCoord in {coordinate.frame.name}: has no place in ICRS; give its obstime and"
            " location, or a place in ICRS"
        ) from error
    roll = 0.0 if roll_deg is None else angle_deg_of(roll_deg, "roll_deg")
    return from_radec_roll_deg(float(icrs.ra.deg), float(icrs.dec.deg), roll)


def _is_quantity(value: Any) -> bool:
    return hasattr(value, "unit") and hasattr(value, "to_value")


def _plain(value: Any, name: str, unit: str, form: str) -> FloatArray:
    """A value's numbers in `unit`, float64."""
    if _is_quantity(value):
        from astropy.units import UnitConversionError

        try:
            return np.asarray(value.to_value("" if unit == "1" else unit), dtype=np.float64)
        except UnitConversionError as error:
            raise InputError(f"{name} in {value.unit}: {form}") from error
    # A number of its own type (a string, a date) would become another one without a word.
    if isinstance(value, (str, bytes)):
        raise InputError(f"{name} {shortened(repr(value))}: {form}")
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} {shortened(repr(value))}: {form}") from error


def _scalar(value: Any, name: str, unit: str, form: str) -> float:
    array = _plain(value, name, unit, form)
    if array.shape != () or not np.isfinite(array):
        raise InputError(f"{name} {shortened(repr(value))}: {form}")
    return float(array)
