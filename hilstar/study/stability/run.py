"""Where methods fail: each case with the method that fails, its error, what hilstar does, and why."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from hilstar.charts import write_csv
from hilstar.study.stability import attitude, codes, field, image, popping, sky, tracker
from hilstar.study.stability.charts import draw_charts
from hilstar.study.stability.failure_case import FailureCase

CASES: tuple[Callable[[], FailureCase], ...] = (
    sky.bluest_star,
    sky.reddest_star,
    sky.temperature_range,
    sky.planck_overflow,
    sky.source_step,
    sky.cool_stars,
    sky.blind_tracker,
    field.motion_at_pole,
    field.fields_over_wrap_and_pole,
    field.boresight_at_pole,
    field.stars_behind,
    field.field_of_180_deg,
    field.weak_perspective,
    image.narrow_star,
    image.wide_star,
    image.negative_wings,
    image.floored_wings,
    image.absurd_sigmas,
    image.star_on_pixel_edge,
    image.star_on_image_edge,
    image.many_stars,
    image.flux_range,
    popping.popping,
    popping.popping_codes,
    codes.stars_half_off,
    codes.stars_a_pixel_apart,
    codes.narrow_codes,
    codes.uneven_panel,
    codes.two_bits,
    codes.sixteen_bits,
    codes.clipped_neighbours,
    codes.all_clipped,
    codes.no_stars,
    tracker.billion_electrons,
    tracker.full_well,
    tracker.empty_field,
    tracker.no_exposure,
    tracker.nan_pixel,
    attitude.two_signs,
    attitude.antipodal,
    attitude.half_turn,
    attitude.fast_turns,
    attitude.not_a_number,
)
COLUMNS = ("case", "verdict", "failing method", "its failure", "what happens", "why", "error", "its error", "tolerance")


def run(directory: Path) -> list[FailureCase]:
    """Measure every case, and write `stability.csv` and the charts; the cases, in order. Raises InputError."""
    cases = [measure() for measure in CASES]
    write_csv(directory / "stability.csv", COLUMNS, [_row(case) for case in cases])
    draw_charts(directory)
    return cases


def _row(case: FailureCase) -> tuple[str | float, ...]:
    verdict, figures = "right" if case.right else "WRONG", case.figures
    numbers = figures.error, figures.fault, figures.tolerance
    return case.case, verdict, case.method, case.fails, case.happens, case.why, *map(float, numbers)
