"""Where methods fail: each case with the failing method, its error, hilstar's way and the
reason; charts of curves.
"""

from collections.abc import Callable
from dataclasses import astuple
from functools import partial
from pathlib import Path

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import (
    BLUE,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    PURPLE,
    chart,
    label_ends,
    plain_ticks,
    two_digits,
    write_csv,
)
from hilstar.basics.files import write_whole
from hilstar.basics.units import magnitude
from hilstar.instruments.study.stability import COLUMNS, FailureCase, image, recorded

# In the order of the light's way, between the recorded cases of catalogue and geometry and those of
# detector and attitude.
DRAWN: tuple[Callable[[], FailureCase], ...] = (
    *(
        image.narrow_star,
        image.wide_star,
        image.negative_wings,
        image.floored_wings,
        image.absurd_sigmas,
    ),
    *(image.star_on_pixel_edge, image.star_on_image_edge, image.many_stars, image.flux_range),
    *(image.popping, image.popping_codes),
    *(*image.CODES, *image.SPILLED, image.no_stars),
)


def run(directory: Path) -> list[FailureCase]:
    """Measure the cases that are drawn, and write `stability.csv` and the charts; all cases in
    order. Raises InputError.
    """
    drawn = [measure() for measure in DRAWN]
    cases = [*recorded("catalogue_and_geometry"), *drawn, *recorded("detector_and_attitude")]
    write_csv(directory / "stability.csv", COLUMNS, [case.row() for case in cases])
    for draw in (narrow_sigmas, weak_perspectives, ripples, turns):
        draw(directory)
    return cases


def _recorded_curves(directory: Path, name: str) -> FloatArray:
    """The columns of a recorded table, which is copied into `directory`."""
    source = Path(__file__).with_name(f"{name}.csv")
    write_whole(directory / source.name, source.read_bytes())
    return np.loadtxt(source, delimiter=",", skiprows=1).T


def narrow_sigmas(directory: Path) -> None:
    """Errors of flux, place and middle pixel against sigma: sampling, and integral over pixels."""
    sigmas_px = np.geomspace(0.1, 2.0, 27)
    pairs = [image.narrow_errors(float(sigma)) for sigma in sigmas_px]
    errors = [(*astuple(integrated), *astuple(points)) for integrated, points in pairs]
    ours, sampled = np.split(np.array(errors).T, 2)
    columns = ("sigma_px", "flux_error", "centroid_error_px", "peak_error")
    sampled_columns = ("sampled_flux_error", "sampled_centroid_error_px", "sampled_peak_error")
    rows = np.column_stack([sigmas_px, errors]).tolist()
    write_csv(directory / "narrow_stars.csv", (*columns, *sampled_columns), rows)
    note = (
        "Largest errors over sub-pixel phases; the place by the centre of gravity. The errors of a"
        " wide sampled star's pixels"
    )
    note += (
        " cancel in its sums, here in float64 and without an end; hilstar draws in float32, and its"
        " sprites end."
    )
    finding = narrow_finding(sigmas_px, ours, sampled)
    with chart(directory / "narrow_stars", finding, panels=3, note=note) as panels:
        for axes, points, integrated in zip(panels, np.abs(sampled), np.abs(ours), strict=True):
            axes.loglog(sigmas_px, points, color=ORANGE, label="sampled")
            axes.loglog(sigmas_px, integrated, color=BLUE, label="integrated (hilstar)")
        panels[0].set_ylabel("flux error [share]")
        panels[1].set_ylabel("place error [px]")
        panels[2].set_ylabel("middle pixel's error [share]")
        panels[-1].set_xlabel("sigma of the star [px]")
        plain_ticks(panels[-1].xaxis, (0.1, 0.2, 0.3, 0.5, 0.85, 1.2, 2))
        label_ends(*panels)


def narrow_finding(sigmas_px: FloatArray, ours: FloatArray, sampled: FloatArray) -> str:
    """From which sigma (n,) on sampling places a star nearer, and its middle pixel; errors (3,
    n).
    """
    nearer = sampled[1] < ours[1]
    if not nearer.any():
        every = f"at every sigma to {sigmas_px[-1]:g} px"
        return f"Integrated over pixels a star is placed nearer than sampled, {every}"
    at = int(nearer.argmax())
    return (
        f"From sigma {sigmas_px[at]:.2f} px on a star sampled at pixel middles is placed nearer"
        f" ({two_digits(sampled[1, at])} px, integrated {two_digits(ours[1, at])}), but its middle"
        f" pixel is {100 * abs(sampled[2, at]):.0f} % too"
        f" {'bright' if sampled[2, at] > 0 else 'faint'}"
    )


def weak_perspectives(directory: Path) -> None:
    """The error of one depth for every star, against the field angle."""
    angle_deg, off_px, off_arcsec = _recorded_curves(directory, "weak_perspective")
    at_px, at_arcsec = (float(np.interp(10.0, angle_deg, off)) for off in (off_px, off_arcsec))
    half_px = float(np.interp(5.0, angle_deg, off_px))
    finding = (
        f"Weak perspective (one depth for every star) is off by {abs(at_px):.0f} px or"
        f" {abs(at_arcsec):.0f} arcsec ten degrees from the axis, and by {abs(half_px / at_px):.2f}"
        " of that at five"
    )
    note = (
        "With the demo's lens and monitor. Perspective proper, as hilstar has it, has no such"
        " error."
    )
    with chart(directory / "weak_perspective", finding, panels=2, note=note) as (above, below):
        above.plot(angle_deg, np.abs(off_px), color=INK)
        below.plot(angle_deg, np.abs(off_arcsec), color=INK)
        above.set(xscale="log", yscale="log", ylabel="error [monitor px]")
        below.set(yscale="log", ylabel="error [arcsec]", xlabel="field angle [deg]")
        plain_ticks(below.xaxis, (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 60))


def ripples(directory: Path) -> None:
    """One star's flux over sub-pixel steps: in the linear image, by codes, and point sampled."""
    on, narrow = image.target(image.SIGMA_PX, image.MOVING_PX), image.target(0.5, image.MOVING_PX)
    with image.by_renderer(on) as draw:
        linear = image.moving_fluxes(draw, on)
    curves = {
        "point sampled, sigma 0.5 px": image.moving_fluxes(
            partial(image.point_sampled, narrow), narrow
        ),
        "codes, round": image.moving_code_fluxes("round"),
        "codes, exact": image.moving_code_fluxes("exact"),
        "linear image": linear,
    }
    off_mag = {name: magnitude(light) for name, light in curves.items()}
    step_px = np.linspace(0, image.PATH_PX[0], image.STEPS)
    columns = "x_px", *(f"{name} [mag]" for name in off_mag)
    write_csv(
        directory / "popping.csv", columns, np.column_stack([step_px, *off_mag.values()]).tolist()
    )
    spread = {name: float(np.ptp(mag)) for name, mag in off_mag.items()}
    finding = (
        f"Moved in sub-pixel steps a star's light varies by {spread['codes, exact']:.3f} mag with"
        f" exact codes and by {spread['codes, round']:.3f} mag with rounded ones"
    )
    note = (
        f"A star {image.CODES_MAG_UNDER_WHITE:g} mag under white, {image.CODES_BITS} bits, sigma"
        f" {image.SIGMA_PX:g} px,"
    )
    note += (
        f" {image.STEPS} steps; it moves in y by {image.PATH_PX[1] / image.PATH_PX[0]:.2f} of its"
        " way in x."
    )
    with chart(directory / "popping", finding, panels=2, note=note) as (above, below):
        for (name, mag), colour in zip(off_mag.items(), (GREEN, ORANGE, BLUE, INK), strict=True):
            above.plot(step_px, mag, color=colour, label=name, lw=1.0)
        below.plot(step_px, 1e6 * off_mag["linear image"], color=INK, lw=1.0, label="linear image")
        above.set(ylabel="light lost [mag]")
        below.set(ylabel="light lost [millionths of a mag]", xlabel="displacement in x [px]")
        label_ends(above, below)


def turns(directory: Path) -> None:
    """Interpolation against the turn from one sample to the next."""
    turn_deg, *errors = _recorded_curves(directory, "turns")
    curves = dict(
        zip(("straight line", "SLERP (without rates)", "with rates"), errors, strict=True)
    )
    largest = curves["with rates"].max()
    finding = (
        "Beyond half a turn between samples SLERP takes the wrong way round; with rates a steady"
        f" turn is followed within {two_digits(largest)} arcsec"
    )
    with chart(directory / "turns", finding) as (axis,):
        for (name, error), colour in zip(curves.items(), (PURPLE, ORANGE, BLUE), strict=True):
            axis.plot(turn_deg, np.maximum(error, 1e-12), color=colour, label=name)
        axis.set(
            yscale="log",
            xlabel="turn between samples [deg]",
            ylabel="largest error between samples [arcsec]",
        )
        plain_ticks(axis.xaxis, (0, 60, 120, 180, 240, 300, 360))
        axis.axvline(180, color=MUTED, ls="--", lw=1.0)
        label_ends(axis)
