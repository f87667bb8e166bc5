"""Cases in which a method fails whatever machine runs it: mathematics, and the detector's noise.

`test_failing_methods.py` holds them. `hilstar study stability` shows their figures as
tools/make_stability.py recorded them, beside the cases that it draws and measures.
"""

from __future__ import annotations

from collections.abc import Callable

from hilstar.instruments.study.stability import FailureCase
from tests.authority.failing_methods import field, sky

# In the order of the light's way. The cases that a machine draws come between the two groups.
CATALOGUE_AND_GEOMETRY: tuple[Callable[[], FailureCase], ...] = (
    *(
        sky.bluest_star,
        sky.reddest_star,
        sky.temperature_range,
        sky.planck_overflow,
        sky.source_step,
        sky.cool_stars,
    ),
    sky.blind_tracker,
    *(
        field.motion_at_pole,
        field.fields_over_wrap_and_pole,
        field.boresight_at_pole,
        field.stars_behind,
    ),
    *(field.field_of_180_deg, field.weak_perspective),
)
DETECTOR_AND_ATTITUDE: tuple[Callable[[], FailureCase], ...] = (
    *(sky.billion_electrons, sky.full_well, sky.empty_field, sky.no_exposure, sky.nan_pixel),
    *(field.two_signs, field.antipodal, field.half_turn, field.fast_turns, field.not_a_number),
)
CURVES = {"weak_perspective": field.weak_perspectives, "turns": field.turns}
