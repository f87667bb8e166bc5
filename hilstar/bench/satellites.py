"""The satellites of a bench: read from its files, and added to the sprites of its frames."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.config import BenchConfig
from hilstar.bench.discs import POINT_PX, When
from hilstar.reading import read_text
from hilstar.rotation import to_matrix
from hilstar.scene.camera import Camera
from hilstar.scene.frame_motion import Scan, Turn
from hilstar.scene.sprites import Sprites
from hilstar.scene.trails import EVERY, Brush, Lit, TrailView, disc_of, disc_trail, hidden, places_of, trails, wide, with_trails
from hilstar.sky.electrons import Optics, Photometry
from hilstar.sky.stars import Stars

if TYPE_CHECKING:
    from hilstar.sky.bodies.disc import Disc
    from hilstar.sky.bodies.moving import MovingSky
    from hilstar.sky.bodies.orbit import Orbit
    from hilstar.sky.bodies.passes import Pass, Satellites

MAX_LIST_BYTES, MAX_TABLE_BYTES = 20_000_000, 5_000_000  # 120 000 sets: several times as many as there are in orbit
# Of all satellites in a frame and in an exposure; a frame's cost as much as 60 stars' paths of 16 px
FRAME_SPRITES, EXPOSURE_SPRITES, EXPOSURE_POSES = 1000, 200_000, 500
ROW_ROUNDS = 2  # as for stars: see `scene.frame_motion`


def bench_satellites(
    config: BenchConfig, folder: Path, orbit: Orbit, zero_and_start_ns: tuple[int, int], optics: Optics
) -> Satellites | None:
    """The satellites that a bench file names, None where it names none; UTCs of t_ns = 0 and of the start.

    Raises InputError for a list or a table that is wrong, MachineError without SGP4.
    """
    from hilstar.sky.bodies.light import bodies_electrons_per_s
    from hilstar.sky.bodies.passes import Satellites
    from hilstar.sky.bodies.satellites import LIST_FORM, TABLE_FORM, brightness_of, read_satellites, read_table

    sky, bodies, (zero_ns, start_ns) = config.sky, config.sky.bodies, zero_and_start_ns
    if bodies.satellites is None:
        return None
    path = folder / bodies.satellites
    found = read_satellites(read_text(path, LIST_FORM, MAX_LIST_BYTES), str(path), start_ns)
    rows = {}
    if bodies.satellite_magnitudes is not None:
        table = folder / bodies.satellite_magnitudes
        rows = read_table(read_text(table, TABLE_FORM, MAX_TABLE_BYTES), str(table))
    photometry = Photometry(sky.zero_point, sky.passband_weighting)
    v0_e_per_s = float(bodies_electrons_per_s(("Sun",), sky.brightness, optics, photometry)[0])
    brightness = brightness_of(found, rows, bodies.satellite_standard_mag, v0_e_per_s)
    satellites = Satellites(found, brightness, v0_e_per_s, orbit, zero_ns)
    satellites.listed = sum(one.number in rows for one in found)
    satellites.file = str(path)
    satellites.place(start_ns)
    return satellites


@dataclass(frozen=True, slots=True)
class Shot:
    """A camera's light: rows as `scan` has them, `begin_s` after the moment of `turn`.

    The sky is that of `t_ns` for an observer with that velocity and place (see `MovingSky.seen`). A pixel shows up to
    `white_e_per_s`.
    """

    camera: Camera
    scan: Scan
    turn: Turn
    t_ns: int | None
    velocity_km_s: FloatArray | None = None
    place_km: FloatArray | None = None
    begin_s: float = 0.0
    white_e_per_s: float = math.inf

    def at_rest(self) -> Shot:
        """The same light of a still picture: all rows at once, and its middle at the moment."""
        return replace(self, scan=Scan(hold_s=self.scan.hold_s), begin_s=-self.scan.hold_s / 2)

    @property
    def longest_s(self) -> float:
        """The farthest from that moment that any light is."""
        return max(abs(self.begin_s), self.scan.longest_s)


def with_satellites(
    sprites: Sprites, stars: Stars, sky: MovingSky | None, shot: Shot, brush: Brush, faintest_e_per_s: float = 0.0
) -> Sprites:
    """The sprites of an image's stars and of the satellites in it of at least `faintest_e_per_s`, which `stars` then has too.

    `stars` are those of `sprites`, as seen at the moment.
    """
    if sky is None or sky.satellites is None:
        return sprites
    from hilstar.sky.bodies.passes import Cone

    camera, turn = shot.camera, shot.turn
    icrs_to_image = camera.cam_to_image @ to_matrix(turn.q_icrs_to_cam)
    reach_rad = camera.field_radius_rad(brush.footprint_px / 2 + 1) + turn.speed_rad_s * shot.longest_s
    cone = Cone(icrs_to_image[2], reach_rad, shot.longest_s, faintest_e_per_s)
    seen = sky.passing(cone, shot.t_ns, shot.velocity_km_s, shot.place_km)
    if seen is None:
        return sprites
    view = TrailView(camera, icrs_to_image, camera.cam_to_image @ turn.rate_cam_rad_s, stars.velocity_km_s)
    close = view.in_reach(seen, shot.longest_s, brush.footprint_px / 2 + 1)
    if not len(close):
        return sprites
    seen = seen.only(close)
    if sky.satellites.sized:
        broad = wide(seen, camera.scales_px_rad()[1], POINT_PX)
        if broad.any():
            sprites = _with_discs(sprites, stars, seen.only(np.flatnonzero(broad)), (view, shot, brush), sky.satellites)
            seen = seen.only(np.flatnonzero(~broad))
    found = trails(seen, view, _lit(seen, view, shot), brush, faintest_e_per_s)
    if not len(found.index):
        return sprites
    sky.satellites.write(stars, found.index, found.middle, found.electrons_per_s)
    return with_trails(sprites, found, len(stars) - len(stars.bodies))


def _with_discs(
    sprites: Sprites, stars: Stars, seen: Pass, how: tuple[TrailView, Shot, Brush], satellites: Satellites
) -> Sprites:
    """The sprites of an image with satellites of a pass as discs, the farthest first, and without what they hide."""
    view, shot, brush = how
    lit, drawn = _lit(seen, view, shot), []
    for k in np.argsort(-np.linalg.norm(seen.seen_km[0], axis=1)):
        own = Lit(lit.begin_s[[k]], lit.length_s)
        found = disc_trail(seen.only(np.array([k])), satellites.names[seen.index[k]], view, own, brush)
        if found is not None:
            drawn.append(found)
            sprites = hidden(sprites, stars.directions(sprites.star), found)
    satellites.write(stars, *places_of(drawn))
    over = tuple(one.along[0].name for one in drawn if one.brightest_e_per_s > shot.white_e_per_s)
    return replace(
        sprites,
        extended=(*sprites.extended, *(light for one in drawn for light in one.lights)),
        discs=(*sprites.discs, *(one.along[0].name for one in drawn)),
        over_white=(*sprites.over_white, *over),
    )


def satellite_discs(sky: MovingSky, stars: Stars, camera: Camera, q_icrs_to_cam: FloatArray, when: When) -> list[Disc]:
    """The satellites on a camera's image at rest that are discs; `stars` are those of the sky as seen at that moment."""
    if sky.satellites is None:
        return []
    from hilstar.sky.bodies.passes import Cone

    icrs_to_image = camera.cam_to_image @ to_matrix(q_icrs_to_cam)
    cone = Cone(icrs_to_image[2], camera.field_radius_rad(0.0), 0.0)
    seen = sky.passing(cone, when.t_ns, when.velocity_km_s, when.place_km)
    if seen is None:
        return []
    names = sky.satellites.names
    broad = np.flatnonzero(wide(seen, camera.scales_px_rad()[1], POINT_PX))
    return [disc_of(seen.only(np.array([k])), names[seen.index[k]], 0.0, stars.velocity_km_s) for k in broad.tolist()]


def _lit(seen: Pass, view: TrailView, shot: Shot) -> Lit:
    """When each satellite's row is lit."""
    late_s = np.zeros(len(seen))
    for _ in range(ROW_ROUNDS if shot.scan.scanout_s else 0):
        x_px, y_px = view.places_px(seen, EVERY, late_s)
        late_s = np.nan_to_num(shot.scan.late_s(x_px, y_px, shot.camera.resolution_px))
    return Lit(shot.begin_s + late_s, shot.scan.hold_s)


def satellite_lines(sky: MovingSky | None, t_ns: int | None) -> list[str]:
    """What there is to say of a bench's satellites at a moment, a line; none where it has none."""
    if sky is None or sky.satellites is None:
        return []
    placed, known, every = sky.satellites_placed(t_ns), sky.satellites.listed, len(sky.satellites)
    return [f"satellites: {placed} of {every} have a place by their elements; {known} are in [sky.bodies] satellite_magnitudes"]


def satellites_now(stars: Stars, sky: MovingSky, t_ns: int | None) -> None:
    """Put every satellite that has light at a moment into the arrays of `stars`, wherever it is in the sky."""
    from hilstar.sky.bodies.passes import Cone

    seen = sky.passing(Cone(np.array([0.0, 0.0, 1.0]), np.pi, 0.0), t_ns)
    if seen is None or sky.satellites is None:
        return
    which, now = np.arange(len(seen)), np.zeros(len(seen))
    rates = seen.rates_e_per_s(which, now, now)
    lit = rates > 0
    sky.satellites.write(stars, seen.index[lit], seen.directions(which[lit], now[lit]), rates[lit])
