"""Each fault of a scenario in the twin: shown alone in a field on which it falls, and taken as what
it adds to that field.

What a fault should bring is what it adds to the linear image, through the same glass. A fault is
asked for, so none of these figures is a reason against a bench.
"""

import math
from dataclasses import dataclass
from typing import Self, TypeGuard

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import from_radec_roll_deg, propagate, random_attitude
from hilstar.basics.units import magnitude
from hilstar.display.quantise import MASK_TURNS
from hilstar.instruments.simulate.star_finder import Matched, StarFinder, star_finder
from hilstar.instruments.simulate.twin import Twin, exposure_lights
from hilstar.optics.layers.fault_kinds import (
    AttitudeStep,
    Blank,
    Drop,
    Fault,
    Flash,
    Freeze,
    Glow,
    Now,
    PlacedFault,
    PointLight,
    StarGone,
)
from hilstar.optics.layers.fault_light import FaultView, icrs_direction
from hilstar.optics.layers.faults import FaultLayer
from hilstar.server.bench.fault_views import display_view
from hilstar.server.bench.frame import Frame
from hilstar.server.bench.scenario import Scenario, lasts_ns

OFF_AXIS = 0.4  # a fault is placed within this share of the field's radius
OFF_FIELD = 1.2  # where a glow's is
WINDOW_SIGMAS = 6.0
NOT_ON_IMAGE = "not on the tracker's image"


@dataclass(frozen=True, slots=True)
class FaultSeen:
    """A fault as the twin's tracker sees it: electrons that it should add in an exposure, and those
    that it adds.

    `flux_mag` is how many magnitudes too faint it is, `off_px` how far from its place, tracker px
    (of a wrong attitude: the stars' median); None where there is no such figure. `note` says why.
    """

    name: str
    kind: str
    asked_e: float | None = None
    seen_e: float | None = None
    flux_mag: float | None = None
    off_px: float | None = None
    note: str = ""


@dataclass(frozen=True, slots=True)
class _Shot:
    """A field in tracker pixels: mean electrons (h, w) of its linear image, and of the monitor
    as it is; and its frame.
    """

    asked_e: FloatArray
    shown_e: FloatArray
    frame: Frame


@dataclass(frozen=True, slots=True)
class FaultWindow:
    """The square of a detector in which a point's light is summed: `reach_px` to each side of its
    middle pixel.
    """

    resolution_px: tuple[int, int]
    reach_px: int

    @classmethod
    def of(cls, resolution_px: tuple[int, int], width_px: tuple[float, float]) -> Self:
        """WINDOW_SIGMAS of the wider axis of a PSF, and a pixel more."""
        return cls(resolution_px, math.ceil(WINDOW_SIGMAS * max(width_px)) + 1)

    def is_whole(self, place_px: FloatArray) -> bool:
        """Whether the window about a place (x, y) is whole on the detector."""
        x, y = place_px
        width, height = self.resolution_px
        reach = self.reach_px
        return bool(reach <= x < width - reach and reach <= y < height - reach)

    def about(self, place_px: FloatArray) -> tuple[slice, slice]:
        """The rows and the columns of the window about a place (x, y)."""
        reach = self.reach_px
        x, y = np.rint(place_px).astype(int).tolist()
        return slice(y - reach, y + reach + 1), slice(x - reach, x + reach + 1)


class FaultyFields:
    """Shows faults one by one on a twin's bench."""

    def __init__(self, twin: Twin, scenario: Scenario, rng: np.random.Generator) -> None:
        self._twin = twin
        self._rng = rng
        self._view: FaultView = display_view(twin.bench, scenario)
        self._faults = scenario.prepared(self._view.prepare)
        self._finder: StarFinder = star_finder(twin.bench, twin.monitor_px_per_px)
        self._view_rad = twin.camera.field_radius_rad(0.0)
        self._window = FaultWindow.of(twin.camera.resolution_px, self._finder.psf.width_px)

    def seen(self) -> list[FaultSeen]:
        """Every fault of the scenario, in its order."""
        return [self._one(fault) for fault in self._faults]

    def _one(self, fault: Fault) -> FaultSeen:
        if isinstance(fault, Freeze | Drop):
            return FaultSeen(
                fault.name,
                fault.KIND,
                note="of the run's frames: a field that stands still has none",
            )
        q = attitude_at(fault, self._direction(fault), self._view_rad, self._rng)
        first_frame = int(self._rng.integers(0, MASK_TURNS))
        effects = FaultLayer(self._view, (Now(1, fault, looked_at_ns(fault)),))
        plain = self._shot(q, first_frame, None)
        faulty = self._shot(q, first_frame, effects)
        if isinstance(fault, AttitudeStep):
            return FaultSeen(fault.name, fault.KIND, off_px=self._stars_off_px(faulty))
        if isinstance(fault, Blank):
            return FaultSeen(
                fault.name, fault.KIND, asked_e=0.0, seen_e=float(faulty.shown_e.sum())
            )
        source = plain if isinstance(fault, StarGone) else faulty
        place_px = self._place_px(fault, source.frame) if _has_place(fault) else None
        asked_e = faulty.asked_e - plain.asked_e
        shown_e = faulty.shown_e - plain.shown_e
        return fault_seen(fault, asked_e, shown_e, place_px, self._window)

    def _shot(self, q: FloatArray, first_frame: int, effects: FaultLayer | None) -> _Shot:
        twin = self._twin
        exposure_s = self._twin.config.tracker.exposure_s
        frame = twin.bench.frame(q, first_frame, faults=effects)
        lights = exposure_lights(twin.bench, frame, first_frame, [twin.true_panel], effects)
        asked = twin.sky_optics.image_e_per_s(frame.linear) * exposure_s
        shown = twin.true_optics.images_e_per_s(lights[0], twin.primaries).sum(axis=0) * exposure_s
        return _Shot(asked, shown, frame)

    def _direction(self, fault: Fault) -> FloatArray | None:
        """A fault's place on the sky; None where it has none of its own."""
        if isinstance(fault, PlacedFault):
            has_place = fault.radec_deg is not None or fault.icrs is not None
            if has_place:
                return icrs_direction(fault)
        if isinstance(fault, Flash | StarGone):
            return self._view.star_direction(fault)
        return None

    def _place_px(self, fault: Fault, frame: Frame) -> FloatArray | None:
        """The tracker pixel of a point, or of a star that is not there, from the truth of a
        frame.
        """
        if isinstance(fault, StarGone):
            vectors = self._twin.bench.stars.vectors[frame.star.clip(0)]
            toward = self._view.star_direction(fault)
            rows = np.flatnonzero(vectors @ toward > 1 - 1e-14)
        else:
            rows = np.flatnonzero(frame.rows["name"] == fault.name)
        if not len(rows):
            return None
        row = frame.rows[rows[:1]]
        x_px, y_px = self._twin.assumed_geometry.to_tracker(row["x_px"], row["y_px"])
        return np.array([x_px[0], y_px[0]])

    def _stars_off_px(self, shot: _Shot) -> float | None:
        """Median distance, px, of the stars shown with a wrong attitude from their places by that
        attitude; None without a match.
        """
        truth = shot.frame.rows
        x_px, y_px = self._twin.assumed_geometry.to_tracker(truth["x_px"], truth["y_px"])
        return median_off_px(self._finder.match(shot.shown_e, x_px, y_px), x_px, y_px)


def _has_place(fault: Fault) -> TypeGuard[PointLight | StarGone]:
    """Whether a fault is one point of an image, as a glow is not."""
    return isinstance(fault, PointLight | StarGone)


def looked_at_ns(fault: Fault) -> int:
    """How long after its beginning a fault is looked at: half way through, or at its beginning
    where it never ends.
    """
    return (lasts_ns(fault) or 0) // 2


def attitude_at(
    fault: Fault, toward: FloatArray | None, view_rad: float, rng: np.random.Generator
) -> FloatArray:
    """An attitude at which a fault in the direction `toward` (3,), ICRS, falls on the image of a
    field of this radius; any one where it has no direction.
    """
    if toward is None:
        return random_attitude(rng)
    ra_deg = np.degrees(np.arctan2(toward[1], toward[0]))
    dec_deg = np.degrees(np.arcsin(np.clip(toward[2], -1, 1)))
    q = from_radec_roll_deg(float(ra_deg), float(dec_deg), float(rng.uniform(0, 360)))
    angle = rng.uniform(0, 2 * np.pi)
    off = OFF_FIELD if isinstance(fault, Glow) else OFF_AXIS * math.sqrt(rng.random())
    axis_cam = np.array([math.cos(angle), math.sin(angle), 0.0])
    return propagate(q, off * view_rad * axis_cam, 1.0)


def fault_seen(
    fault: Fault,
    asked_e: FloatArray,
    shown_e: FloatArray,
    place_px: FloatArray | None,
    window: FaultWindow,
) -> FaultSeen:
    """What a fault adds to an image (h, w), electrons, as asked for and as shown; of a point what
    it adds within the window about its place, None where it has none on the image.
    """
    if _has_place(fault):
        if place_px is None or not window.is_whole(place_px):
            return FaultSeen(fault.name, fault.KIND, note=NOT_ON_IMAGE)
        rows_and_columns = window.about(place_px)
        asked_e = asked_e[rows_and_columns]
        shown_e = shown_e[rows_and_columns]
    asked_sum_e = float(asked_e.sum())
    shown_sum_e = float(shown_e.sum())
    if not abs(asked_sum_e) > 0:
        return FaultSeen(fault.name, fault.KIND, asked_e=0.0, seen_e=shown_sum_e, note=NOT_ON_IMAGE)
    share = shown_sum_e / asked_sum_e
    flux_mag = magnitude(share) if share > 0 else None
    off_px = None
    if _has_place(fault) and share > 0:
        off_px = float(np.hypot(*(_middle(shown_e) - _middle(asked_e))))
    return FaultSeen(fault.name, fault.KIND, asked_sum_e, shown_sum_e, flux_mag, off_px)


def median_off_px(match: Matched, x_px: FloatArray, y_px: FloatArray) -> float | None:
    """The median distance of the matched stars from their places (n,), px; None without a match."""
    is_matched = match.index >= 0
    if not is_matched.any():
        return None
    source = match.index[is_matched]
    right_px = match.found.x_px[source] - x_px[is_matched]
    down_px = match.found.y_px[source] - y_px[is_matched]
    return float(np.median(np.hypot(right_px, down_px)))


def _middle(light: FloatArray) -> FloatArray:
    """The centroid of light (h, w), x and y."""
    y, x = np.indices(light.shape)
    moments = np.array([(x * light).sum(), (y * light).sum()])
    return np.asarray(moments / light.sum())


def fault_lines(seen: list[FaultSeen]) -> list[str]:
    """The figures for a person, a line for each fault."""
    lines = []
    for fault in seen:
        lines.append(f"{'fault':20}{fault.name} ({fault.kind}): {_figures(fault)}")
    return lines


def _figures(fault: FaultSeen) -> str:
    """What was measured of a fault, or its note."""
    if fault.note:
        return fault.note
    parts = []
    if fault.asked_e is not None and fault.seen_e is not None:
        parts.append(f"{fault.asked_e:.6g} e- asked for, {fault.seen_e:.6g} seen")
    if fault.flux_mag is not None:
        parts.append(f"{fault.flux_mag:+.4f} mag")
    if fault.off_px is not None:
        parts.append(f"{fault.off_px:.4f} px off")
    return ", ".join(parts) or "nothing was found"
