"""For your own scripts: unit quaternions, Hamilton, scalar first, and what they do to
directions.

Attitudes may be SciPy rotations, and angles, rates and times Astropy quantities. Raises InputError
for what is neither numbers nor these, and for another shape.

>>> hilstar.rotation.from_radec_roll_deg(84.057, -1.2, 0.0).round(7).tolist()
[0.6987226, 0.713512, -0.0370377, 0.03627]
"""

import inspect
from collections.abc import Callable
from functools import partial, wraps
from typing import Any, ParamSpec, TypeVar

from hilstar.basics import rotation as unchecked
from hilstar.basics.attitudes import (
    angle_deg_of,
    numbers_of,
    quaternions_of,
    rate_of,
    seconds_of,
    share_of,
)
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import turn_text

MAX_DEC_DEG = 90.0

__all__ = [
    "angle_between_rad",
    "conjugate",
    "direction_of",
    "frame_turns",
    "from_matrix",
    "from_radec_roll_deg",
    "from_rotation_vector",
    "from_rotation_vectors",
    "multiply",
    "normalise",
    "propagate",
    "rate_between_rad_s",
    "rotate",
    "slerp",
    "to_matrix",
    "to_radec_roll_deg",
    "to_rotation_vector",
    "turn_text",
]


def __dir__() -> list[str]:
    return __all__


Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

_vectors = partial(numbers_of, axes=("n", 3), what="of components x, y, z")
# By the name of a parameter, what makes numbers of its value.
CHECKS: dict[str, Callable[[Any, str], Any]] = {
    **dict.fromkeys(("q", "a", "b", "q_icrs_to_cam", "earlier", "later"), quaternions_of),
    "vector_rad": partial(_vectors, axes=(3,), unit="rad"),
    "vectors_rad": partial(_vectors, unit="rad"),
    "vectors": partial(_vectors, unit="1"),
    "matrix": partial(numbers_of, axes=(3, 3), unit="1", what="of a rotation"),
    "angle_rad": partial(numbers_of, axes=("n",), unit="rad", what="of angles"),
    "ra_deg": partial(numbers_of, axes=(...,), unit="deg", what="of angles"),
    "dec_deg": partial(numbers_of, axes=(...,), unit="deg", what="of angles"),
    "rate_cam_rad_s": rate_of,
    "seconds": seconds_of,
    "fraction": share_of,
}


def _declination_deg(value: Any, name: str) -> float:
    dec_deg = angle_deg_of(value, name)
    if abs(dec_deg) > MAX_DEC_DEG:
        raise InputError(f"{name} = {dec_deg:g}: a declination is from -90 to 90; swapped with RA?")
    return dec_deg


ONE_PLACE = {
    **dict.fromkeys(("ra_deg", "roll_deg"), angle_deg_of),
    "dec_deg": _declination_deg,
}


def _checked(
    function: Callable[Parameters, Result], **others: Callable[[Any, str], Any]
) -> Callable[Parameters, Result]:
    """The function, with numbers for its arguments by CHECKS, or by `others`."""
    signature = inspect.signature(function)
    checks = CHECKS | others

    @wraps(function)
    def checked(*arguments: Parameters.args, **named: Parameters.kwargs) -> Result:
        try:
            given = signature.bind(*arguments, **named)
        except TypeError as error:
            raise TypeError(f"{function.__name__}() {error}") from error
        for name, value in given.arguments.items():
            if name in checks:
                given.arguments[name] = checks[name](value, name)
        return function(*given.args, **given.kwargs)

    return checked


angle_between_rad = _checked(unchecked.angle_between_rad)
conjugate = _checked(unchecked.conjugate)
direction_of = _checked(unchecked.direction_of)
frame_turns = _checked(unchecked.frame_turns)
from_matrix = _checked(unchecked.from_matrix)
from_radec_roll_deg = _checked(unchecked.from_radec_roll_deg, **ONE_PLACE)
from_rotation_vector = _checked(unchecked.from_rotation_vector)
from_rotation_vectors = _checked(unchecked.from_rotation_vectors)
multiply = _checked(unchecked.multiply)
normalise = _checked(unchecked.normalise)
propagate = _checked(unchecked.propagate)
rate_between_rad_s = _checked(unchecked.rate_between_rad_s)
rotate = _checked(unchecked.rotate)
slerp = _checked(unchecked.slerp)
to_matrix = _checked(unchecked.to_matrix)
to_radec_roll_deg = _checked(unchecked.to_radec_roll_deg)
to_rotation_vector = _checked(unchecked.to_rotation_vector)
