"""The pictures of a session's page: what the tracker saw, and what was found in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.calibrate.first_light.focus import Sharpness
from hilstar.charts import BLUE, DARK, INK, MUTED, ORANGE, SMALL_PT, TEXT_PT, chart
from hilstar.monitor.response import Response

SQUARE_NAMES = ("corner", "right", "below")
MAX_ARROW_SHARE = 0.06  # of the image's width


def draw_spots(path: Path, image: FloatArray, x_px: FloatArray, y_px: FloatArray, finding: str) -> None:
    """An image of the tracker (h, w) with a ring about each spot that was found."""
    with chart(path, finding, height_inch=6.4) as (axes,):
        low, high = (float(value) for value in np.percentile(image, (5, 99.9)))
        axes.imshow(np.sqrt(np.clip(image - low, 0, None)), cmap="gray", vmax=np.sqrt(max(high - low, 1.0)))
        axes.scatter(x_px, y_px, s=260, facecolors="none", edgecolors=DARK[ORANGE], linewidths=1.8)
        plate = {"facecolor": INK, "edgecolor": "none", "boxstyle": "round,pad=0.25"}  # readable over stars and on black
        for name, x, y in zip(SQUARE_NAMES, x_px[:3], y_px[:3], strict=False):
            side = "right" if x > image.shape[1] / 2 else "left"
            away = -14 if side == "right" else 14
            axes.annotate(
                name, (x, y), (away, 16), textcoords="offset points", ha=side, color=DARK[ORANGE], size=TEXT_PT + 1, bbox=plate
            )
        axes.grid(visible=False)
        axes.set_xlabel("tracker x [px]")
        axes.set_ylabel("tracker y [px]")


def draw_focus(path: Path, found: Sharpness, finding: str) -> None:
    """The PSF's sigma at each dot over the tracker's field."""
    with chart(path, finding, height_inch=6.0) as (axes,):
        dots = axes.scatter(found.x_px, found.y_px, c=found.each_psf_sigma_px, cmap="viridis", s=60)
        axes.figure.colorbar(dots, ax=axes, label="PSF sigma [tracker px]")
        axes.set(aspect="equal", xlabel="tracker x [px]", ylabel="tracker y [px]")
        axes.invert_yaxis()


def draw_light(
    path: Path,
    e_per_s: FloatArray,
    off_mag: FloatArray,
    noise_mag: FloatArray,
    finding: str,
    from_middle: FloatArray | None = None,
) -> None:
    """How much too faint stars were seen (n,), magnitudes, over the light that was asked for (n,), electrons per second.

    With `from_middle` (n,), in half sides of the screen, over that as well.
    """
    panels = [("light asked for [e-/s]", e_per_s)]
    panels += [] if from_middle is None else [("from the middle of the screen [half sides]", from_middle)]
    with chart(path, finding, panels=len(panels), share_x=False) as drawn:
        for axes, (name, along) in zip(drawn, panels, strict=True):
            axes.errorbar(along, off_mag, noise_mag, fmt="o", markersize=4, color=INK, ecolor=MUTED)
            axes.axhline(float(np.median(off_mag)), color=MUTED, linewidth=0.8)
            axes.invert_yaxis()
            axes.set(xlabel=name, ylabel="fainter than asked for [mag]")
        drawn[0].set_xscale("log")


def draw_uniformity(path: Path, place: FloatArray, mag: tuple[FloatArray, FloatArray], finding: str) -> None:
    """Dots at places (n, 2) of the screen: how much fainter each is than the brightest place, and than the map has it (n,)."""
    names = "fainter than the brightest place [mag]", "fainter than the map has it [mag]"
    with chart(path, finding, panels=2) as both:
        for axes, off_mag, name in zip(both, mag, names, strict=True):
            low, high = (float(value) for value in np.percentile(off_mag, (0.5, 99.5)))
            dots = axes.scatter(
                place[:, 0], place[:, 1], c=off_mag, s=8, cmap="viridis_r", vmin=low, vmax=max(high, low + 1e-4)
            )
            axes.figure.colorbar(dots, ax=axes, label=name)
            axes.set(aspect="equal", ylabel="monitor y [px]")
            axes.invert_yaxis()
        both[-1].set_xlabel("monitor x [px]")


def draw_response_error(path: Path, response: Response, off_mag: FloatArray, finding: str) -> None:
    """How much fainter the brightest codes are than assumed (n,), magnitudes, over their measured light."""
    with chart(path, finding) as (axes,):
        axes.plot(response.light[-len(off_mag) :], off_mag, color=INK)
        axes.axhline(0, color=MUTED, linewidth=0.8)
        axes.set_xscale("log")
        axes.set(xlabel="measured light over white [share]", ylabel="fainter than in the bench file [mag]")
        axes.invert_yaxis()


def draw_residuals(path: Path, place: FloatArray, residual: FloatArray, width_px: int, finding: str) -> None:
    """Places (n, 2) of stars on the tracker, and how far from there they were seen (n, 2), as arrows."""
    with chart(path, finding, height_inch=6.4) as (axes,):
        largest = max(float(np.hypot(*residual.T).max()), 1e-9)
        look = {"angles": "xy", "scale_units": "xy", "width": 0.003, "color": BLUE}
        arrows = axes.quiver(*place.T, *residual.T, scale=largest / (MAX_ARROW_SHARE * width_px), **look)
        key = {"labelpos": "E", "coordinates": "axes", "fontproperties": {"size": SMALL_PT}}
        axes.quiverkey(arrows, 0.75, 1.03, largest, f"{largest:.3f} px, the longest", **key)
        axes.set(aspect="equal", xlabel="tracker x [px]", ylabel="tracker y [px]")
        axes.invert_yaxis()
