"""Where methods fail: each case with the failing method, its error, hilstar's way and the
reason; charts of curves.
"""

from collections.abc import Mapping
from dataclasses import astuple, replace
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
    two_digits,
    write_csv,
)
from hilstar.basics.files import write_whole
from hilstar.basics.units import magnitude
from hilstar.instruments.study.engine import (
    HIDDEN,
    CurvePanel,
    LevelLine,
    PanelSpec,
    draw_curves,
    write_columns,
)
from hilstar.instruments.study.stability import COLUMNS, FailureCase, image, recorded

SIGMA_TICKS_PX = (0.1, 0.2, 0.3, 0.5, 0.85, 1.2, 2)
FIELD_TICKS_DEG = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 60)
TURN_TICKS_DEG, HALF_TURN_DEG = (0, 60, 120, 180, 240, 300, 360), 180
SMALLEST_ARCSEC = 1e-12  # as drawn
THIN = {"lw": 1.0}
TURN_CURVES = ("straight line", "SLERP (without rates)", "with rates")
# The errors that are drawn, by their columns.
NARROW_LABELS = {
    "flux_error": "flux error [share]",
    "centroid_error_px": "place error [px]",
    "peak_error": "middle pixel's error [share]",
}
NARROW_COLUMNS = (*NARROW_LABELS, *(f"sampled_{name}" for name in NARROW_LABELS))
NARROW_NOTE = (
    "Largest errors over sub-pixel phases; the place by the centre of gravity. The errors of a wide"
    " sampled star's pixels cancel in its sums, here in float64 and without an end; hilstar draws"
    " in float32, and its sprites end."
)
WEAK_NOTE = (
    "With the demo's lens and monitor. Perspective proper, as hilstar has it, has no such error."
)
POPPING_NOTE = (
    f"A star {image.CODES_MAG_UNDER_WHITE:g} mag under white, {image.CODES_BITS} bits, sigma"
    f" {image.SIGMA_PX:g} px, {image.STEPS} steps; it moves in y by"
    f" {image.PATH_PX[1] / image.PATH_PX[0]:.2f} of its way in x."
)


def run(directory: Path) -> list[FailureCase]:
    """Measure the cases that are drawn, and write `stability.csv` and the charts; all cases in
    order. Raises InputError.
    """
    drawn = []
    for measure in image.DRAWN:
        drawn.append(measure())
    geometry = recorded("catalogue_and_geometry")
    attitude = recorded("detector_and_attitude")
    cases = [*geometry, *drawn, *attitude]
    rows = [case.row() for case in cases]
    write_csv(directory / "stability.csv", COLUMNS, rows)
    for draw in (narrow_sigmas, weak_perspectives, ripples, turns):
        draw(directory)
    return cases


def _recorded_curves(directory: Path, name: str) -> FloatArray:
    """The columns of a recorded table, which is copied into `directory`."""
    source = Path(__file__).with_name(f"{name}.csv")
    write_whole(directory / source.name, source.read_bytes())
    columns = np.loadtxt(source, delimiter=",", skiprows=1)
    return columns.T


def narrow_sigmas(directory: Path) -> None:
    """Errors of flux, place and middle pixel against sigma: sampling, and integral over pixels."""
    sigmas_px = np.geomspace(0.1, 2.0, 27)
    table: dict[str, list[float]] = {name: [] for name in NARROW_COLUMNS}
    for sigma_px in sigmas_px.tolist():
        integrated, sampled = image.narrow_errors(sigma_px)
        errors = (*astuple(integrated), *astuple(sampled))
        for name, error in zip(NARROW_COLUMNS, errors, strict=True):
            table[name].append(error)
    columns = {}
    for name, column in table.items():
        columns[name] = np.array(column)
    write_columns(directory / "narrow_stars.csv", {"sigma_px": sigmas_px, **columns})
    panels = []
    for name, label in NARROW_LABELS.items():
        integrated_errors = np.abs(columns[name])
        sampled_errors = np.abs(columns[f"sampled_{name}"])
        curves = {
            "sampled": sampled_errors,
            "integrated (hilstar)": integrated_errors,
        }
        spec = PanelSpec((), label, scales=("log", "log"))
        panel = CurvePanel(sigmas_px, curves, spec, (ORANGE, BLUE))
        panels.append(panel)
    last = replace(panels[-1].spec, xlabel="sigma of the star [px]", xticks=SIGMA_TICKS_PX)
    panels[-1] = replace(panels[-1], spec=last)
    finding = narrow_finding(sigmas_px, columns)
    draw_curves(directory / "narrow_stars", finding, panels, NARROW_NOTE)


def narrow_finding(sigmas_px: FloatArray, errors: Mapping[str, FloatArray]) -> str:
    """From which sigma (n,) on sampling places a star nearer, and its middle pixel then; errors
    (n,) by NARROW_COLUMNS.
    """
    own_px = errors["centroid_error_px"]
    sampled_px = errors["sampled_centroid_error_px"]
    nearer = sampled_px < own_px
    if not nearer.any():
        every = f"at every sigma to {sigmas_px[-1]:g} px"
        return f"Integrated over pixels a star is placed nearer than sampled, {every}"
    at = int(nearer.argmax())
    sampled_at_px = two_digits(sampled_px[at])
    own_at_px = two_digits(own_px[at])
    places = f"{sampled_at_px} px, integrated {own_at_px}"
    peak = errors["sampled_peak_error"][at]
    too = "bright" if peak > 0 else "faint"
    peak_percent = 100 * abs(peak)
    return (
        f"From sigma {sigmas_px[at]:.2f} px on a star sampled at pixel middles is placed nearer"
        f" ({places}), but its middle pixel is {peak_percent:.0f} % too {too}"
    )


def weak_perspectives(directory: Path) -> None:
    """The error of one depth for every star, against the field angle."""
    angle_deg, off_px, off_arcsec = _recorded_curves(directory, "weak_perspective")
    at_ten_px = float(np.interp(10.0, angle_deg, off_px))
    at_ten_arcsec = float(np.interp(10.0, angle_deg, off_arcsec))
    at_five_px = float(np.interp(5.0, angle_deg, off_px))
    share = abs(at_five_px / at_ten_px)
    ten_px = abs(at_ten_px)
    ten_arcsec = abs(at_ten_arcsec)
    finding = (
        f"Weak perspective (one depth for every star) is off by {ten_px:.0f} px or"
        f" {ten_arcsec:.0f} arcsec ten degrees from the axis, and by {share:.2f} of that at"
        " five"
    )
    above = PanelSpec((), "error [monitor px]", scales=("log", "log"), names=False)
    below = replace(
        above, ylabel="error [arcsec]", xlabel="field angle [deg]", xticks=FIELD_TICKS_DEG
    )
    shown_px = np.abs(off_px)
    shown_arcsec = np.abs(off_arcsec)
    upper = CurvePanel(angle_deg, {HIDDEN: shown_px}, above, (INK,))
    lower = CurvePanel(angle_deg, {HIDDEN: shown_arcsec}, below, (INK,))
    panels = (
        upper,
        lower,
    )
    draw_curves(directory / "weak_perspective", finding, panels, WEAK_NOTE)


def moving_lights() -> dict[str, FloatArray]:
    """One moving star's light (steps,) by the way it is drawn."""
    on = image.target(image.SIGMA_PX, image.MOVING_PX)
    narrow = image.target(0.5, image.MOVING_PX)
    sampled = partial(image.point_sampled, narrow)
    with image.by_renderer(on) as draw:
        linear = image.moving_fluxes(draw, on)
    sampled_light = image.moving_fluxes(sampled, narrow)
    round_light = image.moving_code_fluxes("round")
    exact_light = image.moving_code_fluxes("exact")
    return {
        "point sampled, sigma 0.5 px": sampled_light,
        "codes, round": round_light,
        "codes, exact": exact_light,
        "linear image": linear,
    }


def ripples(directory: Path) -> None:
    """One star's flux over sub-pixel steps: in the linear image, by codes, and point sampled."""
    curves = moving_lights()
    step_px = np.linspace(0, image.PATH_PX[0], image.STEPS)
    columns = {"x_px": step_px}
    off_mag = {}
    spread = {}
    for name, light in curves.items():
        mag = magnitude(light)
        off_mag[name] = mag
        columns[f"{name} [mag]"] = mag
        spread[name] = float(np.ptp(mag))
    write_columns(directory / "popping.csv", columns)
    exact_mag = spread["codes, exact"]
    round_mag = spread["codes, round"]
    finding = (
        f"Moved in sub-pixel steps a star's light varies by {exact_mag:.3f} mag with"
        f" exact codes and by {round_mag:.3f} mag with rounded ones"
    )
    millionths = 1e6 * off_mag["linear image"]
    linear_only = {"linear image": millionths}
    above = PanelSpec((), "light lost [mag]")
    below = PanelSpec((), "light lost [millionths of a mag]", "displacement in x [px]")
    colours = (GREEN, ORANGE, BLUE, INK)
    upper = CurvePanel(step_px, off_mag, above, colours, THIN)
    lower = CurvePanel(step_px, linear_only, below, (INK,), THIN)
    panels = (
        upper,
        lower,
    )
    draw_curves(directory / "popping", finding, panels, POPPING_NOTE)


def turns(directory: Path) -> None:
    """Interpolation against the turn from one sample to the next."""
    turn_deg, *errors = _recorded_curves(directory, "turns")
    curves = dict(zip(TURN_CURVES, errors, strict=True))
    largest = curves["with rates"].max()
    within_arcsec = two_digits(largest)
    finding = (
        "Beyond half a turn between samples SLERP takes the wrong way round; with rates a steady"
        f" turn is followed within {within_arcsec} arcsec"
    )
    drawn = {}
    for name, error in curves.items():
        drawn[name] = np.maximum(error, SMALLEST_ARCSEC)
    half_turn = LevelLine(HALF_TURN_DEG, HIDDEN, MUTED, width=1.0)
    spec = PanelSpec(
        ylabel="largest error between samples [arcsec]",
        xlabel="turn between samples [deg]",
        scales=("linear", "log"),
        xticks=TURN_TICKS_DEG,
        places=(half_turn,),
    )
    panel = CurvePanel(turn_deg, drawn, spec, (PURPLE, ORANGE, BLUE))
    draw_curves(directory / "turns", finding, (panel,))
