"""Charts of the cases that are curves: the failing method and hilstar over the quantity that makes it fail."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from hilstar.charts import chart, plain_ticks, write_csv
from hilstar.study.stability.attitude import sampled_error_arcsec, straight_line, way_error_arcsec
from hilstar.study.stability.field import weak_perspective_error
from hilstar.study.stability.image import SIGMA_PX, by_renderer, narrow_errors, point_sampled, target
from hilstar.study.stability.popping import (
    CODES_BITS,
    CODES_MAG_UNDER_WHITE,
    IMAGE_PX,
    PATH_PX,
    STEPS,
    moving_code_fluxes,
    moving_fluxes,
)
from hilstar.units import magnitude


def draw_charts(directory: Path) -> None:
    """Write each chart (PNG) and its table (CSV) into `directory`."""
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
    at, wide = int(np.abs(sigmas_px - 0.5).argmin()), sigmas_px > 0.85
    either = float(np.maximum(flux, sampled_flux)[wide].max())
    finding = (
        f"At sigma {sigma[at]:.2f} px point sampling is off by {100 * sampled_flux[at]:.1f} % in flux and"
        f" {sampled_px[at]:.3f} px in centroid, integration over pixels by {100 * flux[at]:.5f} % and {off_px[at]:.4f} px."
        f" Above 0.85 px both are within {either:.0e} in flux"
    )
    with chart(directory / "narrow_stars.png", finding, panels=2) as (above, below):
        for axis, theirs, ours in ((above, sampled_flux, flux), (below, sampled_px, off_px)):
            axis.plot(sigma, theirs, "C3", label="the Gaussian's value at the middle of each pixel")
            axis.plot(sigma, ours, "C0", label="integrated over pixels (hilstar)")
            axis.set(xscale="log", yscale="log")
        above.set(ylabel="flux error, relative\nlargest over phases")
        below.set(ylabel="centre of gravity [px]\nlargest error over phases", xlabel="sigma of the star [px]")
        plain_ticks(below.xaxis, (0.1, 0.2, 0.3, 0.5, 0.85, 1, 2))
        above.legend()


def weak_perspectives(directory: Path) -> None:
    """What one depth for every star costs against the field angle."""
    angle_deg = np.geomspace(0.1, 60.0, 200)
    off_px, off_arcsec = weak_perspective_error(angle_deg)
    rows = np.column_stack([angle_deg, off_px, off_arcsec]).tolist()
    write_csv(directory / "weak_perspective.csv", ("field_angle_deg", "error_px", "error_arcsec"), rows)
    at_px, at_arcsec = (float(off[0]) for off in weak_perspective_error(np.array([10.0])))
    finding = (
        f"With the demo's lens and monitor, weak perspective (one depth for every star) is off by {abs(at_px):.0f} px or"
        f" {abs(at_arcsec):.0f} arcsec at a field angle of ten degrees, and by an eighth of that at five"
    )
    with chart(directory / "weak_perspective.png", finding, panels=2) as (above, below):
        above.plot(angle_deg, np.abs(off_px), "C3")
        below.plot(angle_deg, np.abs(off_arcsec), "C3")
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
        f"A star {CODES_MAG_UNDER_WHITE:g} mag under white, {CODES_BITS} bits, sigma {SIGMA_PX:g} px, moves in {STEPS}"
        f" sub-pixel steps: its light varies by {spread['linear image']:.1e} mag in the linear image,"
        f" by {spread['codes, exact']:.3f} with exact codes and by {spread['codes, round']:.3f} with rounded ones"
    )
    with chart(directory / "popping.png", finding, panels=2) as (above, below):
        for (name, mag), colour in zip(off_mag.items(), ("C1", "C3", "C0", "k"), strict=True):
            above.plot(step_px, mag, colour, label=name, lw=1.0)
        below.plot(step_px, 1e6 * off_mag["linear image"], "k", lw=1.0)
        above.set(ylabel="light lost [mag]")
        below.set(
            ylabel="linear image alone,\nlight lost [1e-6 mag]",
            xlabel=f"displacement in x [px]; that in y is {PATH_PX[1] / PATH_PX[0]:.2f} of it",
        )
        above.margins(y=0.2)
        above.legend(ncols=4, loc="upper center")


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
        f" within {largest:.0e} arcsec up to {turn_deg[-1]:.0f} degrees"
    )
    with chart(directory / "turns.png", finding) as (axis,):
        for (name, errors), style in zip(curves.items(), ("C1", "C3", "C0"), strict=True):
            axis.plot(turn_deg, np.maximum(errors, 1e-12), style, label=name)
        axis.set(yscale="log", xlabel="turn between samples [deg]", ylabel="largest error between samples [arcsec]")
        plain_ticks(axis.xaxis, (0, 60, 120, 180, 240, 300, 360))
        axis.axvline(180, color="k", ls="--", lw=1.0)
        axis.legend(loc="center right")
