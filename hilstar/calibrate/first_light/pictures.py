"""The pictures of a session's page: what the tracker saw, and what was found in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.calibrate.first_light.focus import Sharpness
from hilstar.charts import chart
from hilstar.monitor.response import Response

SQUARE_NAMES = ("corner", "right", "below")
MAX_ARROW_SHARE = 0.06  # of the image's width


def draw_spots(path: Path, image: FloatArray, x_px: FloatArray, y_px: FloatArray, finding: str) -> None:
    """An image of the tracker (h, w) with a ring about each spot that was found."""
    with chart(path, finding) as (axes,):
        low, high = (float(value) for value in np.percentile(image, (5, 99.9)))
        axes.imshow(np.sqrt(np.clip(image - low, 0, None)), cmap="gray", vmax=np.sqrt(max(high - low, 1.0)))
        axes.scatter(x_px, y_px, s=260, facecolors="none", edgecolors="tab:orange")
        for number, (x, y) in enumerate(zip(x_px[:3], y_px[:3], strict=True)):
            axes.annotate(SQUARE_NAMES[number], (x, y), (14, 14), textcoords="offset points", color="tab:orange")
        axes.grid(visible=False)
        axes.set_xlabel("tracker x [px]")
        axes.set_ylabel("tracker y [px]")


def draw_focus(path: Path, found: Sharpness, finding: str) -> None:
    """The sigma of each dot over the tracker's field."""
    with chart(path, finding) as (axes,):
        dots = axes.scatter(found.x_px, found.y_px, c=found.sigma_px, cmap="viridis", s=60)
        axes.figure.colorbar(dots, ax=axes, label="sigma of the dot [px]")
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
            axes.errorbar(along, off_mag, noise_mag, fmt="o", markersize=4)
            axes.axhline(float(np.median(off_mag)), color="0.5", linewidth=0.8)
            axes.invert_yaxis()
            axes.set(xlabel=name, ylabel="seen - asked for [mag]")
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
        axes.plot(response.light[-len(off_mag) :], off_mag)
        axes.axhline(0, color="0.5", linewidth=0.8)
        axes.set_xscale("log")
        axes.set(xlabel="measured light above black / white", ylabel="measured - in the bench file [mag]")
        axes.invert_yaxis()


def draw_residuals(path: Path, place: FloatArray, residual: FloatArray, width_px: int, finding: str) -> None:
    """Places (n, 2) of stars on the tracker, and how far from there they were seen (n, 2), as arrows."""
    with chart(path, finding) as (axes,):
        largest = max(float(np.hypot(*residual.T).max()), 1e-9)
        arrow = residual * MAX_ARROW_SHARE * width_px / largest
        axes.quiver(*place.T, *arrow.T, angles="xy", scale_units="xy", scale=1, width=0.002)
        axes.set(aspect="equal", xlabel="tracker x [px]", ylabel="tracker y [px]")
        axes.set_title(f"the longest arrow is {largest:.3f} px", fontsize=11)
        axes.invert_yaxis()
