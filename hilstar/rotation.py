"""For your own scripts: unit quaternions, Hamilton, scalar first, and what they do to
directions.

>>> hilstar.rotation.from_radec_roll_deg(84.057, -1.2, 0.0).round(7).tolist()
[0.6987226, 0.713512, -0.0370377, 0.03627]
"""

from hilstar.basics.rotation import (
    angle_between_rad,
    conjugate,
    direction_of,
    frame_turns,
    from_matrix,
    from_radec_roll_deg,
    from_rotation_vector,
    from_rotation_vectors,
    multiply,
    normalise,
    propagate,
    rate_between_rad_s,
    rotate,
    slerp,
    to_matrix,
    to_radec_roll_deg,
    to_rotation_vector,
    turn_text,
)

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
