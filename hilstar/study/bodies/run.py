"""Charts of what each body costs in a frame, how exact its disc is at each size, and what happens as it fills the field."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hilstar.charts import chart, plain_ticks, write_records
from hilstar.study.bodies.cost import SCENES, Cost, measure
from hilstar.study.bodies.limits import NEAR_DEG, QUICK_DEG, Near, approach
from hilstar.study.bodies.scenes import BODIES, REFRESH_HZ, opened
from hilstar.study.bodies.size import PHASES_DEG, QUICK_RADII_PX, RADII_PX, Exactness
from hilstar.study.bodies.size import measure as exactness

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ROUNDS, QUICK_ROUNDS = 40, 3
QUICK_BENCHES = ("nothing", "Moon", "Sun", "Earth", "all")
FREE_MS = 0.3  # what the fastest of one frame and of the same one again differ by
FLUX_LIMIT, LIMB_LIMIT_PX, DISC_PX = 0.01, 0.1, 0.2
FLOOR = 1e-6  # of the chart's axis


def run(directory: Path, quick: bool = False) -> list[str]:
    """Write `bodies_cost`, `bodies_size` and `bodies_limits` (PNG and CSV); a line for each finding. Raises InputError."""
    rounds = QUICK_ROUNDS if quick else ROUNDS
    scenes = [scene for scene in SCENES if scene.bench in QUICK_BENCHES] if quick else SCENES
    with opened(QUICK_BENCHES if quick else tuple(BODIES)) as benches:
        costs = [measure(benches, scene, rounds) for scene in scenes]
        nears = [
            approach(benches, body, off_deg, max(QUICK_ROUNDS, rounds // 4))
            for body, angles in (QUICK_DEG if quick else NEAR_DEG).items()
            for off_deg in angles
        ]
    sizes = [exactness(radius, phase) for phase in PHASES_DEG for radius in (QUICK_RADII_PX if quick else RADII_PX)]
    findings = [_cost_line(costs), _size_line(sizes), _limits_line(nears)]
    for name, records in (("bodies_cost", costs), ("bodies_size", sizes), ("bodies_limits", nears)):
        write_records(directory / f"{name}.csv", records)
    _draw_costs(directory / "bodies_cost.png", costs, findings[0])
    _draw_sizes(directory / "bodies_size.png", sizes, findings[1])
    _draw_limits(directory / "bodies_limits.png", nears, findings[2])
    return findings


def _cost_line(costs: Sequence[Cost]) -> str:
    dearest, step = max(costs, key=lambda cost: cost.cpu_ms), costs[-1]
    unseen = max((c for c in costs[:-1] if not c.discs), key=lambda cost: cost.cpu_ms)
    return (
        f"bodies that are not in view, or points, take at most {max(unseen.cpu_ms, 0.0):.1f} ms of processor time a frame, and"
        f" all of them {max(step.cpu_ms, 0.0):.1f} ms once in 2 s; the dearest: {dearest.scene}, {dearest.cpu_ms:.0f} ms"
    )


def _size_line(sizes: Sequence[Exactness]) -> str:
    limb_px = float(np.nanmax([size.limb_off_px for size in sizes]))
    worst = max(sizes, key=lambda size: abs(size.flux_off))
    return (
        f"discs of {sizes[0].radius_px:g} to {max(s.radius_px for s in sizes):g} px in radius have their light within"
        f" {abs(worst.flux_off):.2%} and their limb within {limb_px:.3f} px of rays in float64"
    )


def _limits_line(nears: Sequence[Near]) -> str:
    slowest = max(nears, key=lambda near: near.cpu_ms)
    sound = all(near.finite and near.white_is_white for near in nears)
    light = "finite, and what is over white is white" if sound else "NOT finite, or over white and not white"
    return (
        f"from {max(n.off_deg for n in nears):g} degrees away to a full field every pixel's light is {light}; a frame takes at"
        f" most {slowest.cpu_ms:.0f} ms of processor time, {slowest.body} at {slowest.off_deg:g} degrees"
    )


def _draw_costs(path: Path, costs: Sequence[Cost], finding: str) -> None:
    with chart(path, finding) as (axes,):
        names = [cost.scene for cost in costs][::-1]
        axes.barh(names, [max(cost.cost_ms, 0.0) for cost in costs][::-1], color="tab:blue")
        axes.plot([max(cost.cpu_ms, 0.0) for cost in costs][::-1], names, "kd", markersize=5, label="processor time, all cores")
        for place, cost in enumerate(costs[::-1]):
            axes.annotate(f" {cost.cost_ms:.2f}", (max(cost.cost_ms, 0.0), place), va="center", fontsize=9)
        axes.set_xscale("symlog", linthresh=FREE_MS)
        plain_ticks(axes.xaxis, (0, 0.1, 0.2, 0.3, 1, 3, 10, 30, 100))
        axes.axvline(FREE_MS, color="grey", linestyle=":", label="what the same frame differs by")
        axes.set_xlabel("ms a frame against a bench without bodies, 1920 x 1080")
        axes.set_xlim(0, 3 * max(cost.cost_ms for cost in costs))
        axes.legend(loc="upper right")


def _draw_sizes(path: Path, sizes: Sequence[Exactness], finding: str) -> None:
    with chart(path, finding, panels=3) as (flux, limb, point):
        for phase_deg in PHASES_DEG:
            rows = [size for size in sizes if size.phase_deg == phase_deg]
            radius = [size.radius_px for size in rows]
            label = f"{phase_deg:g} degrees of phase"
            flux.plot(radius, [max(abs(size.flux_off), FLOOR) for size in rows], "o-", label=label)
            (line,) = limb.plot(radius, [max(size.middle_off_px, FLOOR) for size in rows], "o:")
            limb.plot(radius, [size.limb_off_px for size in rows], "s-", color=line.get_color())
            point.plot(radius, [size.pixel_off for size in rows], "o-", color=line.get_color())
            point.plot(radius, [size.point_pixel_off for size in rows], "x:", color=line.get_color())
        _limit(flux, FLUX_LIMIT, "1 %")
        _limit(limb, LIMB_LIMIT_PX, "0.1 px")
        flux.set_ylabel("light, relative error")
        limb.set_ylabel("px: middle (dotted), limb (squares)")
        point.set_ylabel("worst pixel / brightest:\ndisc (line), point (crosses)")
        point.axvline(DISC_PX / 2, color="grey", linestyle="--")
        point.annotate(" drawn as a point to the left", (DISC_PX / 2, point.get_ylim()[0]), va="bottom", fontsize=9)
        flux.legend()
        for axes in (flux, limb, point):
            axes.set_xscale("log")
            axes.set_yscale("log")
        plain_ticks(point.xaxis, (0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50))
        point.set_xlabel("radius of the Moon's disc, px")


def _limit(axes: Axes, value: float, name: str) -> None:
    axes.axhline(value, color="grey", linestyle="--")
    axes.annotate(name, (1.0, value), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=9)


def _draw_limits(path: Path, nears: Sequence[Near], finding: str) -> None:
    with chart(path, finding, panels=2) as (times, light):
        for body in dict.fromkeys(near.body for near in nears):
            rows = [near for near in nears if near.body == body]
            off_deg = [near.off_deg for near in rows]
            label = f"{body}'s limb" if body == "Earth" else f"{body}'s middle"
            (line,) = times.plot(off_deg, [near.frame_ms for near in rows], "o-", label=label)
            times.plot(off_deg, [near.cpu_ms for near in rows], "d:", markersize=4, color=line.get_color())
            light.plot(off_deg, [near.over_white_mag for near in rows], "o-")
        times.plot([n.off_deg for n in nears], [n.without_ms for n in nears], ".", color="grey", label="without bodies")
        times.axhline(1e3 / REFRESH_HZ, color="grey", linestyle="--", label=f"a frame of {REFRESH_HZ:g} Hz")
        times.set_ylim(bottom=0)
        times.set_ylabel("ms a frame (dotted: processor time)")
        times.legend(ncols=2)
        light.axhline(0, color="grey", linestyle="--")
        light.set_ylabel("brightest pixel over white, mag")
        light.set_xlabel("degrees from the boresight (negative: on the Earth)")
        light.set_xscale("symlog", linthresh=1.0)
        plain_ticks(light.xaxis, (-70, -20, -8, -3, -1, 0, 1, 3, 8, 20, 40))
