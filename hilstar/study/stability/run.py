"""Where methods fail: each case with the failing method, its error, what hilstar does, and why; charts of curves."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from hilstar.charts import BLUE, GREEN, INK, MUTED, ORANGE, PURPLE, chart, label_ends, plain_ticks, two_digits, write_csv
from hilstar.study.stability import FailureCase, field, image, sky
from hilstar.study.stability.field import (
    CODES_BITS,
    CODES_MAG_UNDER_WHITE,
    IMAGE_PX,
    PATH_PX,
    STEPS,
    moving_code_fluxes,
    moving_fluxes,
    sampled_error_arcsec,
    straight_line,
    way_error_arcsec,
    weak_perspective_error,
)
from hilstar.study.stability.image import SIGMA_PX, by_renderer, narrow_errors, point_sampled, target
from hilstar.units import magnitude

# In the order of the light's way: catalogue, geometry, image, codes, detector, attitude.
CASES: tuple[Callable[[], FailureCase], ...] = (
    *(sky.bluest_star, sky.reddest_star, sky.temperature_range, sky.planck_overflow, sky.source_step, sky.cool_stars),
    sky.blind_tracker,
    *(field.motion_at_pole, field.fields_over_wrap_and_pole, field.boresight_at_pole, field.stars_behind),
    *(field.field_of_180_deg, field.weak_perspective),
    *(image.narrow_star, image.wide_star, image.negative_wings, image.floored_wings, image.absurd_sigmas),
    *(image.star_on_pixel_edge, image.star_on_image_edge, image.many_stars, image.flux_range),
    *(field.popping, field.popping_codes),
    *(image.stars_half_off, image.stars_a_pixel_apart, image.narrow_codes, image.uneven_panel, image.two_bits),
    *(image.sixteen_bits, image.clipped_neighbours, image.all_clipped, image.no_stars),
    *(sky.billion_electrons, sky.full_well, sky.empty_field, sky.no_exposure, sky.nan_pixel),
    *(field.two_signs, field.antipodal, field.half_turn, field.fast_turns, field.not_a_number),
)
COLUMNS = ("case", "verdict", "failing method", "its failure", "what happens", "why", "error", "its error", "tolerance")


def draw_charts(directory: Path) -> None:
    """Write each chart and its table (CSV) into `directory`."""
    for draw in (narrow_sigmas, weak_perspectives, ripples, turns):
        draw(directory)


def narrow_sigmas(directory: Path) -> None:
    """Flux and centroid error against sigma: point sampling, and the integral over pixels."""
    sigmas_px = np.geomspace(0.1, 2.0, 27)
    pairs = [narrow_errors(float(sigma)) for sigma in sigmas_px]
    errors = [(ours.flux, ours.centroid_px, sampled.flux, sampled.centroid_px) for ours, sampled in pairs]
    rows = np.column_stack([sigmas_px, errors]).tolist()
    columns = ("sigma_px", "flux_error", "centroid_error_px", "sampled_flux_error", "sampled_centroid_error_px")
    write_csv(directory / "narrow_stars.csv", columns, rows)
    sigma, flux, off_px, sampled_flux, sampled_px = np.array(rows).T
    at = int(np.abs(sigmas_px - 0.5).argmin())
    finding = (
        f"At sigma {sigma[at]:.2f} px a star sampled at pixel middles is off by {100 * sampled_flux[at]:.1f} % and"
        f" {sampled_px[at]:.3f} px, integrated over pixels by {100 * flux[at]:.5f} % and {off_px[at]:.4f} px"
    )
    note = "Largest errors over sub-pixel phases; the place by the centre of gravity."
    with chart(directory / "narrow_stars", finding, panels=2, note=note) as (above, below):
        for axes, theirs, ours in ((above, sampled_flux, flux), (below, sampled_px, off_px)):
            axes.loglog(sigma, theirs, color=ORANGE, label="sampled")
            axes.loglog(sigma, ours, color=BLUE, label="integrated (hilstar)")
        above.set(ylabel="flux error [share]")
        below.set(ylabel="place error [px]", xlabel="sigma of the star [px]")
        plain_ticks(below.xaxis, (0.1, 0.2, 0.3, 0.5, 0.85, 1.2, 2))
        label_ends(above, below)


def weak_perspectives(directory: Path) -> None:
    """What one depth for every star costs against the field angle."""
    angle_deg = np.geomspace(0.1, 60.0, 200)
    off_px, off_arcsec = weak_perspective_error(angle_deg)
    rows = np.column_stack([angle_deg, off_px, off_arcsec]).tolist()
    write_csv(directory / "weak_perspective.csv", ("field_angle_deg", "error_px", "error_arcsec"), rows)
    at_px, at_arcsec = (float(off[0]) for off in weak_perspective_error(np.array([10.0])))
    finding = (
        f"Weak perspective (one depth for every star) is off by {abs(at_px):.0f} px or {abs(at_arcsec):.0f} arcsec ten degrees"
        " from the axis, and by an eighth of that at five"
    )
    note = "With the demo's lens and monitor. Perspective proper, as hilstar has it, has no such error."
    with chart(directory / "weak_perspective", finding, panels=2, note=note) as (above, below):
        above.plot(angle_deg, np.abs(off_px), color=INK)
        below.plot(angle_deg, np.abs(off_arcsec), color=INK)
        above.set(xscale="log", yscale="log", ylabel="error [monitor px]")
        below.set(yscale="log", ylabel="error [arcsec]", xlabel="field angle [deg]")
        plain_ticks(below.xaxis, (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 60))


def ripples(directory: Path) -> None:
    """One star's flux over sub-pixel steps: in the linear image, by codes, and point sampled."""
    on, narrow = target(SIGMA_PX, IMAGE_PX), target(0.5, IMAGE_PX)
    with by_renderer(on) as draw:
        linear = moving_fluxes(draw, on)
    curves = {
        "point sampled, sigma 0.5 px": moving_fluxes(partial(point_sampled, narrow), narrow),
        "codes, round": moving_code_fluxes("round"),
        "codes, exact": moving_code_fluxes("exact"),
        "linear image": linear,
    }
    off_mag = {name: magnitude(light) for name, light in curves.items()}
    step_px = np.linspace(0, PATH_PX[0], STEPS)
    columns = "x_px", *(f"{name} [mag]" for name in off_mag)
    write_csv(directory / "popping.csv", columns, np.column_stack([step_px, *off_mag.values()]).tolist())
    spread = {name: float(np.ptp(mag)) for name, mag in off_mag.items()}
    finding = (
        f"Moved in sub-pixel steps a star's light varies by {spread['codes, exact']:.3f} mag with exact codes and by"
        f" {spread['codes, round']:.3f} mag with rounded ones"
    )
    note = f"A star {CODES_MAG_UNDER_WHITE:g} mag under white, {CODES_BITS} bits, sigma {SIGMA_PX:g} px, {STEPS} steps;"
    note += f" it moves in y by {PATH_PX[1] / PATH_PX[0]:.2f} of its way in x."
    with chart(directory / "popping", finding, panels=2, note=note) as (above, below):
        for (name, mag), colour in zip(off_mag.items(), (GREEN, ORANGE, BLUE, INK), strict=True):
            above.plot(step_px, mag, color=colour, label=name, lw=1.0)
        below.plot(step_px, 1e6 * off_mag["linear image"], color=INK, lw=1.0, label="linear image")
        above.set(ylabel="light lost [mag]")
        below.set(ylabel="light lost [millionths of a mag]", xlabel="displacement in x [px]")
        label_ends(above, below)


def turns(directory: Path) -> None:
    """Interpolation against the turn from one sample to the next."""
    turn_deg = np.concatenate([np.linspace(5, 175, 35), [178.0, 179.9, 180.1, 182.0], np.linspace(185, 355, 35)])
    curves = {
        "straight line, normalised": [way_error_arcsec(straight_line, 1.0, float(t)) for t in turn_deg],
        "SLERP (samples without rates)": [sampled_error_arcsec(float(t), False) for t in turn_deg],
        "samples with rates": [sampled_error_arcsec(float(t), True) for t in turn_deg],
    }
    columns = "turn_deg", *(f"{name} [arcsec]" for name in curves)
    write_csv(directory / "turns.csv", columns, np.column_stack([turn_deg, *curves.values()]).tolist())
    largest = max(curves["samples with rates"])
    finding = (
        "Beyond half a turn between samples SLERP takes the wrong way round; with rates a steady turn is followed"
        f" within {two_digits(largest)} arcsec"
    )
    with chart(directory / "turns", finding) as (axis,):
        for (name, errors), colour in zip(curves.items(), (PURPLE, ORANGE, BLUE), strict=True):
            axis.plot(
                turn_deg,
                np.maximum(errors, 1e-12),
                color=colour,
                label=name.replace("samples ", "").replace(", normalised", ""),
            )
        axis.set(yscale="log", xlabel="turn between samples [deg]", ylabel="largest error between samples [arcsec]")
        plain_ticks(axis.xaxis, (0, 60, 120, 180, 240, 300, 360))
        axis.axvline(180, color=MUTED, ls="--", lw=1.0)
        label_ends(axis)


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
