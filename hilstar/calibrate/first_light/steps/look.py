"""The steps until the tracker sees the screen upright and sharp: machine, display, orientation, focus."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hilstar.bench.bench_file import BenchFile
from hilstar.calibrate.first_light.focus import Sharpness, sharpness
from hilstar.calibrate.first_light.orientation import (
    UPRIGHT,
    WAYS,
    Mounting,
    SeenFigure,
    corrected,
    keys_of_ways,
    look_of,
    mounting_of,
    see_figure,
)
from hilstar.calibrate.first_light.patterns import Pattern, figure_for
from hilstar.calibrate.first_light.pictures import draw_focus, draw_spots
from hilstar.calibrate.first_light.records import Change, Figure, Outcome
from hilstar.calibrate.first_light.rewrite import with_changes
from hilstar.calibrate.first_light.rooms import Looked, Room
from hilstar.calibrate.geometric.dots import DotPlan, dot_image, plan_dots
from hilstar.errors import InputError, MachineError
from hilstar.run.doctor import examine

PLAN_SEED = 0
FRAMES = 20
MIN_LIT, MAX_LIT = 12, 60  # dots in a frame
TRACKER_PX_A_DOT = 40.0  # between the dots of a frame: so many fit beside each other
DOT_PX = 3  # side of a dot, monitor px
BLURRED = 1.3  # times the bench file's sigma
BLURRED_BY_PX = 0.1
MS_PER_S = 1000.0


def machine(room: Room) -> Outcome:
    """Ask the machine what it has. Raises MachineError for what it lacks."""
    found = examine()
    missing = [check for check in found.checks if check.required and not check.ok]
    if missing:
        raise MachineError("; ".join(f"{check.name}: {check.detail}" for check in missing))
    figures = {check.name: check.detail for check in found.checks}
    return Outcome("done", figures["opengl"], figures)


def display(room: Room) -> Outcome:
    """Measure the display. Raises MachineError for one that is not as the bench file has it."""
    timing = room.eyes.gate(room.file)
    if timing is None:
        return Outcome("skipped", f"no display of this program's own ({room.eyes.identity.partition(':')[0]})")
    figures: dict[str, Figure] = {"period_ms": timing.period_ms, "dropped": timing.dropped}
    if timing.paced_by_screen:
        figures["refresh_hz"] = MS_PER_S / timing.period_ms
    if timing.modes_hz:
        figures["modes_hz"] = " ".join(map(str, timing.modes_hz))
    paced = "" if timing.paced_by_screen else "; the display has no refresh of its own, frames are paced by software"
    return Outcome("done", f"a frame every {timing.period_ms:.3f} ms, {timing.dropped} dropped{paced}", figures)


def orientation(room: Room) -> Outcome:
    """Find how the screen is mounted, set the bench file so, and see the figure upright. Raises InputError."""
    before = mounting_of(room.file.config.monitor)
    seen = first = _way(room, "figure_000")
    changes = _mounting_changes(room.file, before, corrected(before, first.way))
    if changes:
        turned = room.with_file(with_changes(room.file, changes))
        seen = _way(turned, "figure_001")
        if seen.way != UPRIGHT:
            made = "; ".join(change.line for change in changes)
            raise InputError(f"after {made} the figure is {WAYS[seen.way]}; is it the same screen?")
    way = f"first {WAYS[first.way]}, now upright" if changes else "upright"
    if seen.measured is None:
        figures: dict[str, Figure] = {"seen": WAYS[first.way], "told_by": "a key"}
        return Outcome("done", f"{way}, as a person saw it", figures, changes=changes)
    found, looked = seen.measured
    picture = room.session / "orientation.png"
    draw_spots(picture, looked.image, found.x_px, found.y_px, f"the figure as the tracker sees it: {way}")
    figures = {"seen": WAYS[first.way], "scale": found.scale, "turn_deg": found.turn_deg}
    line = f"{way}, {found.scale:.4f} of the expected size, turned by {found.turn_deg:+.2f} deg"
    return Outcome("done", line, figures, (looked.path, picture), (picture,), changes)


@dataclass(frozen=True, slots=True)
class _Seen:
    """Which way round the figure stands; as it was measured, None where a person told it by a key."""

    way: tuple[int, int, int, int]
    measured: tuple[SeenFigure, Looked] | None


def _way(room: Room, name: str) -> _Seen:
    geometry = room.geometry()
    figure = figure_for(geometry)
    pattern, keys = figure.pattern(name, room.resolution_px, room.white), keys_of_ways()
    told = room.take_or_key(pattern, {key: look_of(way) for key, way in keys.items()})
    if isinstance(told, str):
        return _Seen(keys[told], None)
    looked = room.looked(told, room.read(room.dark()))
    found = see_figure(looked.image, figure, geometry)
    return _Seen(found.way, (found, looked))


def _mounting_changes(file: BenchFile, before: Mounting, after: Mounting) -> tuple[Change, ...]:
    pairs = [(key, getattr(before, key), getattr(after, key)) for key in ("flip_x", "flip_y", "rotate_deg")]
    changes = [Change(table="monitor", key=key, before=old, after=new) for key, old, new in pairs if old != new]
    if (before.rotate_deg - after.rotate_deg) % 180:
        width, height = file.config.monitor.resolution_px
        changes.append(Change(table="monitor", key="resolution_px", before=[width, height], after=[height, width]))
    return tuple(changes)


def plan_for(room: Room) -> DotPlan:
    """The dots that this screen shows this tracker: as many as stand apart. Raises InputError."""
    geometry = room.geometry()
    ratio = geometry.tracker.focal_length_px / geometry.monitor.focal_length_px
    seen = [min(ratio * wide, size) for wide, size in zip(room.resolution_px, geometry.tracker.resolution_px, strict=True)]
    lit = int(np.clip(seen[0] * seen[1] / TRACKER_PX_A_DOT**2, MIN_LIT, MAX_LIT))
    return plan_dots(room.resolution_px, FRAMES, lit, np.random.default_rng(PLAN_SEED))


def focus(room: Room) -> Outcome:
    """Measure how sharp the dots are, and at which code they do not saturate the tracker. Raises InputError."""
    code, found, looked = sharp_dots(room)
    wanted = float(np.hypot(*room.file.config.tracker.psf_sigma_px) / np.sqrt(2))
    picture = room.session / "focus.png"
    sigma = found.psf_sigma_px
    draw_focus(
        picture, found, f"PSF sigma {sigma:.3f} px (median of {len(found.x_px)} dots), [tracker] psf_sigma_px is {wanted:g}"
    )
    figures = {
        "psf_sigma_px": sigma,
        "dot_sigma_px": float(np.median(found.sigma_px)),
        "dots": len(found.x_px),
        "dot_code": code,
    }
    files = (looked.path, picture)
    line = f"PSF sigma {sigma:.3f} px, the bench file says {wanted:g}; dots at code {code}"
    if sigma > BLURRED * wanted + BLURRED_BY_PX:
        cure = "turn the focus until this figure is smallest (--again focus), or write [tracker] psf_sigma_px as it is"
        return Outcome("failed", f"{line}: {cure}", figures, files, (picture,))
    return Outcome("done", line, figures, files, (picture,))


def sharp_dots(room: Room) -> tuple[int, Sharpness, Looked]:
    """The brightest code whose dots do not saturate the tracker, and how sharp they are. Raises InputError."""
    geometry, plan, code = room.geometry(), plan_for(room), room.white
    dark = room.read(room.dark())
    for number in range(room.file.config.monitor.bits * 2):
        codes = dot_image(plan, 0, room.resolution_px, code)
        looked = room.look(Pattern(f"dots_{number:03}", codes), dark)
        if not room.is_too_bright(looked):
            break
        code = room.darker(code)
    side = DOT_PX * geometry.tracker.focal_length_px / geometry.monitor.focal_length_px
    return code, sharpness(looked.image, side), looked
