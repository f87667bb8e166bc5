"""An exposure in which something goes wrong: cut where a fault begins or ends, each piece with its own sky and attitude."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.bench.faults.desk import Now
from hilstar.bench.faults.effects import Effects
from hilstar.bench.faults.kinds import CosmicRays
from hilstar.bench.faults.timetable import Timetable
from hilstar.bench.faults.view import FaultView
from hilstar.bench.truth import TRUTH_DTYPE, added_truth
from hilstar.rotation import propagate
from hilstar.scene.camera import Camera
from hilstar.scene.exposure_motion import Motion, smeared_sprites
from hilstar.scene.frame_motion import Scan
from hilstar.scene.sprites import Sprites, join_sprites
from hilstar.sky.stars import Stars
from hilstar.units import NS_PER_S

# The attitude at a time of the run, ns.
AttitudeAt = Callable[[int], FloatArray]


@dataclass(frozen=True, slots=True)
class Piece:
    """A part of an exposure in which the same faults are on: its own motion, and what is on when it begins."""

    motion: Motion
    now: tuple[Now, ...]


def pieces_of(motion: Motion, run_ns: int, timetable: Timetable, attitude_at: AttitudeAt | None = None) -> tuple[Piece, ...]:
    """The pieces of an exposure whose middle is at `run_ns` of a scenario.

    `attitude_at` says where a display that stands still has stopped; by default it had the exposure's own rate.
    """

    def at_constant_rate(t_ns: int) -> FloatArray:
        if t_ns == run_ns:
            return motion.q_icrs_to_cam
        return propagate(motion.q_icrs_to_cam, motion.rate_cam_rad_s, (t_ns - run_ns) / NS_PER_S)

    where = attitude_at or at_constant_rate
    half_ns = round(motion.exposure_s * NS_PER_S / 2)
    edges = timetable.edges_ns(run_ns - half_ns, run_ns + half_ns)
    found = []
    for begin_ns, end_ns in itertools.pairwise(edges):
        middle_ns = (begin_ns + end_ns) // 2
        since_ns, now = timetable.stands_since_ns(middle_ns), timetable.on(middle_ns, begin_ns)
        q, rate = at_constant_rate(middle_ns), motion.rate_cam_rad_s
        if since_ns is not None:
            q, rate = where(since_ns), np.zeros(3)
        t_ns = None if motion.t_ns is None else motion.t_ns + middle_ns - run_ns
        found.append(Piece(Motion(q, rate, (end_ns - begin_ns) / NS_PER_S, t_ns), now))
    return tuple(found)


@dataclass(frozen=True, slots=True)
class Lens:
    """What draws on a tracker's detector: its camera, the footprint and the sigmas of its PSF."""

    camera: Camera
    footprint_px: int
    sigma_px: tuple[float, float]


class FaultyExposure:
    """One exposure with its faults, as `Simulator.expose` draws it, piece by piece."""

    def __init__(self, view: FaultView, pieces: Sequence[Piece]) -> None:
        self._view, self.pieces = view, pieces
        self._seen: list[Sprites] = []
        self._rows: list[tuple[npt.NDArray[np.void], float]] = []

    def light_e(
        self, stars: Stars, lens: Lens, sprites_of: Callable[[Motion], Sprites], linear: Callable[[Sprites], FloatArray]
    ) -> tuple[FloatArray, float]:
        """Electrons (h, w) of the whole exposure, and the seconds of it in which the field is not blank.

        `sprites_of` makes the sprites of `stars` in a motion, `linear` the image of sprites.
        """
        total: FloatArray | None = None
        open_s = 0.0
        exposure_s = sum(piece.motion.exposure_s for piece in self.pieces)
        for piece in self.pieces:
            effects, motion = Effects(self._view, piece.now), piece.motion
            q, rate = effects.turned(motion.q_icrs_to_cam), effects.turned_rate(motion.rate_cam_rad_s)
            motion = replace(motion, q_icrs_to_cam=q, rate_cam_rad_s=rate)
            sprites = effects.over(sprites_of(motion), stars, q, _drawer(motion, lens), Scan(hold_s=motion.exposure_s))
            light = linear(sprites) * motion.exposure_s
            total = light if total is None else total + light
            open_s += 0.0 if effects.blank else motion.exposure_s
            self._note(sprites, effects, motion.exposure_s / exposure_s)
        if total is None:
            raise AssertionError("an exposure has a piece")
        return total, open_s

    def _note(self, sprites: Sprites, effects: Effects, share: float) -> None:
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
    """Add the light of a point in another piece of the exposure."""
    before, more = float(into["electrons_per_s"]), float(row["electrons_per_s"])
    for place in ("x_px", "y_px"):
        into[place] = (into[place] * before + row[place] * more) / (before + more)
    into["electrons_per_s"] = before + more


def _drawer(motion: Motion, lens: Lens) -> Callable[[Stars], Sprites]:
    return lambda few: smeared_sprites(few, motion, lens.camera, lens.footprint_px, lens.sigma_px)


def _own(sprites: Sprites) -> Sprites:
    """Sprites without light that a fault adds."""
    if not sprites.added:
        return sprites
    own = sprites.star >= 0
    x_px, y_px = sprites.x_px[own], sprites.y_px[own]
    return replace(sprites, data=sprites.data[own], star=sprites.star[own], x_px=x_px, y_px=y_px, added=())
