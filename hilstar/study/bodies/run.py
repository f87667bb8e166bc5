"""Charts of what each body costs in a frame, how exact its disc is at each size, and what happens as it fills the field."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hilstar.charts import BLUE, INK, MUTED, SERIES, capital, chart, label_ends, plain_ticks, value_bars, write_records
from hilstar.study.bodies.cost import SCENES, Cost, measure
from hilstar.study.bodies.limits import NEAR_DEG, QUICK_DEG, Near, approach
from hilstar.study.bodies.scenes import BODIES, REFRESH_HZ, opened
from hilstar.study.bodies.size import PHASES_DEG, QUICK_RADII_PX, RADII_PX, Exactness
from hilstar.study.bodies.size import measure as exactness

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
    draw_costs(directory / "bodies_cost", costs)
    draw_sizes(directory / "bodies_size", sizes)
    draw_limits(directory / "bodies_limits", nears)
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
        f" {100 * abs(worst.flux_off):.2g} % and their limb within {limb_px:.3f} px of rays in float64"
    )


def _limits_line(nears: Sequence[Near]) -> str:
    slowest = max(nears, key=lambda near: near.cpu_ms)
    sound = all(near.finite and near.white_is_white for near in nears)
    light = "finite, and white where it is over white" if sound else "NOT finite, or over white and not white"
    return (
        f"a body in view takes at most {slowest.cpu_ms:.0f} ms of processor time a frame ({slowest.body} at {slowest.off_deg:g}"
        f" degrees); every pixel's light is {light}"
    )


def draw_costs(path: Path, costs: Sequence[Cost]) -> None:
    """What each scene costs."""
    dearest, unseen = (max(some, key=lambda cost: cost.cpu_ms) for some in (costs, [c for c in costs[:-1] if not c.discs]))
    note = "Processor time of a frame, less that of the same frame on a bench without bodies; 1920 x 1080, drawn in software."
    points = f"Bodies that are no discs cost at most {max(unseen.cpu_ms, 0):.1f} ms"
    finding = f"{points}; the dearest, {dearest.scene}, {dearest.cpu_ms:.0f} ms"
    with chart(path, finding, note=note, height_inch=4.4) as (axes,):
        value_bars(axes, [capital(cost.scene) for cost in costs], [round(max(cost.cpu_ms, 0.0), 2) for cost in costs], BLUE)
        axes.set_xlabel("processor time on top [ms]")


def draw_sizes(path: Path, sizes: Sequence[Exactness]) -> None:
    """The errors of discs against their radius."""
    note = f"A Moon at {len(PHASES_DEG)} phases, against rays in float64. Left of the dashed line it is drawn as a point."
    with chart(path, _size_line(sizes), panels=3, note=note, height_inch=8.4) as panels:
        light, place, pixel = panels
        for phase_deg, colour in zip(PHASES_DEG, SERIES, strict=False):
            rows = [size for size in sizes if size.phase_deg == phase_deg]
            radius, label = [size.radius_px for size in rows], f"{phase_deg:g} deg"
            for axes, name, style, shown in (
                (light, "flux_off", "o-", label),
                (place, "limb_off_px", "s-", "_"),
                (place, "middle_off_px", "o:", label),
                (pixel, "pixel_off", "o-", label),
                (pixel, "point_pixel_off", "x:", "_"),
            ):
                values = [max(abs(getattr(size, name)), FLOOR) for size in rows]
                axes.loglog(radius, values, style, color=colour, ms=4, label=shown)
        light.set(title="Light of the whole disc", ylabel="error [share]")
        place.set(title="Place of its limb (squares, solid) and of its middle (dotted)", ylabel="error [px]")
        pixel.set(
            title="Its worst pixel, drawn as a disc (solid) and as a point (crosses, dotted)", ylabel="error [of the brightest]"
        )
        pixel.axvline(DISC_PX / 2, color=MUTED, linestyle="--", lw=1.2, label="_")
        for axes, limit in ((light, FLUX_LIMIT), (place, LIMB_LIMIT_PX)):
            axes.axhline(limit, color=INK, linestyle="--", lw=1.2, label="limit")
        plain_ticks(pixel.xaxis, sorted({size.radius_px for size in sizes}))
        pixel.set_xlabel("radius of the Moon's disc [px]")
        for axes in panels:
            label_ends(axes)


def draw_limits(path: Path, nears: Sequence[Near]) -> None:
    """Processor time and light as bodies come near."""
    note = "Earth by its limb, negative on the Earth; Moon and Sun by their middles. 1920 x 1080, drawn in software."
    with chart(path, _limits_line(nears), panels=2, note=note) as (times, light):
        for body, colour in zip(dict.fromkeys(near.body for near in nears), SERIES, strict=False):
            rows = [near for near in nears if near.body == body]
            off_deg = [near.off_deg for near in rows]
            times.plot(off_deg, [near.cpu_ms for near in rows], "o-", ms=4, color=colour, label=body)
            light.plot(off_deg, [near.over_white_mag for near in rows], "o-", ms=4, color=colour, label=body)
        times.axhline(1e3 / REFRESH_HZ, color=INK, linestyle="--", lw=1.2, label=f"{REFRESH_HZ:g} Hz")
        light.axhline(0, color=INK, linestyle="--", lw=1.2, label="white")
        times.set_ylim(bottom=0)
        times.set_ylabel("processor time of a frame [ms]")
        light.set_ylabel("brightest pixel over white [mag]")
        light.set_xlabel("angle from the boresight [deg]")
        light.set_xscale("symlog", linthresh=1.0)
        plain_ticks(light.xaxis, (-70, -20, -8, -3, -1, 0, 1, 3, 8, 20, 40))
        for axes in (times, light):
            label_ends(axes)
