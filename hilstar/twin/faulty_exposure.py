"""An exposure in which something goes wrong: cut where a fault begins or ends, each piece with its own sky and attitude."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.bench.scenario import Timetable
from hilstar.frame.fault_kinds import CosmicRays, Now
from hilstar.frame.fault_light import FaultView
from hilstar.frame.faults import FaultLayer
from hilstar.frame.truth import TRUTH_DTYPE, added_truth
from hilstar.frame.view import STILL, View
from hilstar.rotation import propagate
from hilstar.scene.frame_motion import Scan
from hilstar.scene.sprites import Sprites, join_sprites
from hilstar.units import NS_PER_S

# The attitude at a time of the run, ns.
AttitudeAt = Callable[[int], FloatArray]


@dataclass(frozen=True, slots=True)
class ExposurePiece:
    """A part of an exposure in which the same faults are on: its own view, and what is on when it begins."""

    view: View
    now: tuple[Now, ...]


def pieces_of(
    view: View, run_ns: int, timetable: Timetable, attitude_at: AttitudeAt | None = None
) -> tuple[ExposurePiece, ...]:
    """The pieces of an exposure whose middle is at `run_ns` of a scenario.

    `attitude_at` gives the attitude at which a display that stands still has stopped; by default it had the exposure's rate.
    """
    rate = view.turn.rate_cam_rad_s

    def at_constant_rate(t_ns: int) -> FloatArray:
        if t_ns == run_ns:
            return view.q_icrs_to_cam
        return propagate(view.q_icrs_to_cam, rate, (t_ns - run_ns) / NS_PER_S)

    where = attitude_at or at_constant_rate
    half_ns = round(view.exposure_s * NS_PER_S / 2)
    edges = timetable.edges_ns(run_ns - half_ns, run_ns + half_ns)
    found = []
    for begin_ns, end_ns in itertools.pairwise(edges):
        middle_ns = (begin_ns + end_ns) // 2
        since_ns, now = timetable.stands_since_ns(middle_ns), timetable.on(middle_ns, begin_ns)
        part = replace(
            view,
            q_icrs_to_cam=at_constant_rate(middle_ns) if since_ns is None else where(since_ns),
            rate_cam_rad_s=rate if since_ns is None else STILL,
            t_ns=None if view.t_ns is None else view.t_ns + middle_ns - run_ns,
            scan=Scan(hold_s=(end_ns - begin_ns) / NS_PER_S),
        )
        found.append(ExposurePiece(part, now))
    return tuple(found)


class FaultyExposure:
    """One exposure with its faults, as `Simulator.expose` draws it, piece by piece."""

    def __init__(self, view: FaultView, pieces: Sequence[ExposurePiece]) -> None:
        self._view, self.pieces = view, pieces
        self._seen: list[Sprites] = []
        self._rows: list[tuple[npt.NDArray[np.void], float]] = []

    def light_e(
        self, light_of: Callable[[View, FaultLayer], Sprites], linear: Callable[[Sprites], FloatArray]
    ) -> tuple[FloatArray, float]:
        """Electrons (h, w) of the whole exposure, and the seconds of it in which the field is not blank.

        `light_of` makes the light of a view with faults, `linear` its image, electrons per second.
        """
        total: FloatArray | None = None
        open_s = 0.0
        exposure_s = sum(piece.view.exposure_s for piece in self.pieces)
        for piece in self.pieces:
            layer, piece_s = FaultLayer(self._view, piece.now), piece.view.exposure_s
            sprites = light_of(layer.turned(piece.view), layer)
            light = linear(sprites) * piece_s
            total = light if total is None else total + light
            open_s += 0.0 if layer.blank else piece_s
            self._note(sprites, piece_s / exposure_s)
        if total is None:
            raise AssertionError("an exposure has a piece")
        return total, open_s

    def _note(self, sprites: Sprites, share: float) -> None:
        self._seen.append(sprites)
        if sprites.added:
            self._rows.append((added_truth(sprites, np.zeros(len(sprites), dtype=bool)), share))

    @property
    def names(self) -> tuple[str, ...]:
        """The faults that are on in it."""
        return tuple(dict.fromkeys(one.fault.name for piece in self.pieces for one in piece.now))

    def sprites(self) -> Sprites:
        """The sprites of the bench's own stars and discs in any of its pieces, end to end."""
        parts = [_own(sprites) for sprites in self._seen]
        whole = join_sprites(parts, parts[0].footprint_px)
        discs = tuple(dict.fromkeys(name for part in parts for name in part.discs))
        return replace(whole, capped=sum(part.capped for part in parts), discs=discs)

    def added_truth(self) -> npt.NDArray[np.void]:
        """Rows of TRUTH_DTYPE for what faults added: in electrons per second of the whole exposure, at the mean place."""
        tracks = {one.fault.name for piece in self.pieces for one in piece.now if isinstance(one.fault, CosmicRays)}
        points: dict[str, npt.NDArray[np.void]] = {}
        found: list[npt.NDArray[np.void]] = []
        for rows, share in self._rows:
            rows["electrons_per_s"] *= share
            for row in rows:
                name = str(row["name"])
                if name in tracks:
                    found.append(row)
                elif name in points:
                    _merge(points[name], row)
                else:
                    points[name] = row.copy()
        made = np.zeros(len(points) + len(found), dtype=TRUTH_DTYPE)
        for k, row in enumerate([*points.values(), *found]):
            made[k] = row
        return made


def _merge(into: npt.NDArray[np.void], row: npt.NDArray[np.void]) -> None:
    """Add the light of the same point in another piece of the exposure."""
    before, more = float(into["electrons_per_s"]), float(row["electrons_per_s"])
    for place in ("x_px", "y_px"):
        into[place] = (into[place] * before + row[place] * more) / (before + more)
    into["electrons_per_s"] = before + more


def _own(sprites: Sprites) -> Sprites:
    """Sprites without light that a fault adds."""
    if not sprites.added:
        return sprites
    own = sprites.star >= 0
    x_px, y_px = sprites.x_px[own], sprites.y_px[own]
    return replace(sprites, data=sprites.data[own], star=sprites.star[own], x_px=x_px, y_px=y_px, added=())
