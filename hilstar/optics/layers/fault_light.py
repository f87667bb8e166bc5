"""The light that faults add to one camera's image, and the stars that they take away.

The display and the virtual tracker have a `FaultView` each; nothing else differs between them.
"""

import math
import re
import threading
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import direction_of, to_matrix
from hilstar.basics.units import NS_PER_S, flux_ratio, magnitude
from hilstar.optics import extended
from hilstar.optics.camera import Camera
from hilstar.optics.layers.fault_kinds import (
    CosmicRays,
    FalseStar,
    Fault,
    Flash,
    Glow,
    Gradient,
    MeasuredMap,
    Now,
    PlacedFault,
    PointLight,
    StarGone,
)
from hilstar.optics.layers.star_layer import StarLayer
from hilstar.optics.layers.stray_light import gradient_image, map_image, read_map
from hilstar.optics.layers.view import Canvas
from hilstar.optics.psf import Psf
from hilstar.optics.scan import Scan
from hilstar.optics.sprites import AddedLight, FrameLight, pack_sprites
from hilstar.sky.named_stars import hip_named
from hilstar.sky.stars import Stars

TRACK_SEED = 2  # beside the number of an exposure
# a track has no colour; its magnitude is that of a white star of as many electrons
TRACK_BV_MAG = 0.0
KEPT_MAPS, KEPT_BURSTS, KEPT_STARS = 16, 64, 512  # a stream may ask for any star
# Sprites this many sigmas apart make a line whose brightness ripples by 2 exp(-2 pi^2 / 1.5^2) =
# 3e-4.
STEP_SIGMA = 1.5
MAX_STEPS = 20_000  # on one line


@dataclass(frozen=True, slots=True)
class FaultCamera:
    """A camera's canvas and what a fault has to know to be drawn on it: the bench's two cameras,
    and its light.

    `points` draws a few stars as the camera's own are drawn, `apparent` turns directions (n, 3),
    ICRS, into those that the bench's observer sees, and `v0_e_per_s` gives the electrons per second
    of a star of V = 0 by its B-V.
    """

    canvas: Canvas
    monitor: Camera
    tracker: Camera
    exposure_s: float
    points: StarLayer
    apparent: Callable[[FloatArray], FloatArray]
    v0_e_per_s: Callable[[float], float]
    stars: Stars


class FaultView:
    """The faults of one camera. A fault of the stream may be prepared while another thread draws.

    `seed` is that of everything random in them. Maps are files in `folder` (None: a message names
    no file); those of the `lasting` faults are kept.
    """

    def __init__(
        self,
        by: FaultCamera,
        seed: int = 0,
        folder: Path | None = None,
        lasting: frozenset[Fault] = frozenset(),
    ) -> None:
        self.by = by
        self._seed = seed
        self._folder = folder
        self._lasting = lasting
        self._glow_kept: tuple[Fault, float, extended.GlowLight] | None = None
        self._lock = threading.Lock()
        self._found: dict[tuple[int, int | str], tuple[object, IntArray]] = {}
        self._maps: dict[Fault, extended.LightMap] = {}
        self._tracks: dict[tuple[str, int], PointChain] = {}

    def prepare(self, fault: Fault) -> Fault:
        """The fault with everything prepared that a frame has no time for. Raises InputError
        (see `FaultSchedule`).
        """
        if not self.by.exposure_s and getattr(fault, "electrons", None) is not None:
            raise InputError(
                "electrons: [tracker] exposure_s is 0, and no exposure has them; write a longer one"
            )
        if isinstance(fault, CosmicRays) and fault.for_s is None:
            fault = msgspec.structs.replace(fault, for_s=self.by.exposure_s)
        by_star = isinstance(fault, Flash | StarGone) and (fault.hip or fault.star)
        if by_star and not len(self._places(self.by.stars, fault)):
            if isinstance(by_star, str):
                star_key = f'star = "{by_star}"'
            else:
                star_key = f"hip = {by_star}"
            raise InputError(
                f"{star_key}: not among the {len(self.by.stars)} stars and bodies of this bench;"
                " write one that is, or look at [sky] faintest_v_mag"
            )
        if isinstance(fault, PointLight | CosmicRays):
            self.by.v0_e_per_s(getattr(fault, "bv_mag", TRACK_BV_MAG))
        if isinstance(fault, Gradient | MeasuredMap):
            self._map(fault)
        if isinstance(fault, PlacedFault) and (
            fault.tracker_px is not None or fault.screen_px is not None
        ):
            camera, place = self._source(fault)
            if not np.isfinite(camera.rays(np.array([place[0]]), np.array([place[1]]))).all():
                if fault.tracker_px is not None:
                    key = "tracker_px"
                else:
                    key = "screen_px"
                raise InputError(
                    f"{key} = {list(place)}: the lens has no direction there; write a place nearer"
                    " to the image"
                )
        return fault

    def light_e_per_s(self, fault: Fault) -> float:
        """A fault's electrons per second: of a point, or in the tracker's brightest pixel; 1
        where a map says it.
        """
        per_s = getattr(fault, "electrons_per_s", None)
        in_exposure = getattr(fault, "electrons", None)
        if per_s is not None:
            return float(per_s)
        if in_exposure is not None:
            return float(in_exposure) / self.by.exposure_s
        if isinstance(fault, PointLight) and fault.v_mag is not None:
            return float(flux_ratio(fault.v_mag)) * self.by.v0_e_per_s(fault.bv_mag)
        return 1.0

    def rng(self, name: str, *numbers: int) -> np.random.Generator:
        """The randomness of a fault: by the scenario's seed, the fault's name, and numbers."""
        return np.random.default_rng((self._seed, zlib.crc32(name.encode()), *numbers))

    def _map(self, fault: Gradient | MeasuredMap) -> extended.LightMap:
        """A fault's light over the image where the brightest tracker pixel has its light."""
        with self._lock:
            known = self._maps.get(fault)
        if known is None:
            by = self.by
            camera = self.by.canvas.camera
            if isinstance(fault, Gradient):
                image = gradient_image(fault, camera, by.tracker)
            elif self._folder is None:
                advice = (
                    "a message names no files; write the fault in the scenario, and start it by"
                    " name"
                )
                raise InputError(f"file = {fault.file!r}: {advice}")
            else:
                values = read_map(self._folder / fault.file)
                # The fault states the light of the brightest pixel, else the map's own is meant.
                if fault.electrons_per_s is not None or fault.electrons is not None:
                    values = values / values.max()
                of_its_frame = by.tracker if fault.frame == "tracker" else by.monitor
                image = map_image(values, fault, camera, of_its_frame)
            known = extended.LightMap(image, times=self.light_e_per_s(fault), bv_mag=fault.bv_mag)
        with self._lock:
            self._maps.pop(fault, None)
            self._maps[fault] = known  # the last used is the last to go
            others = [key for key in self._maps if key not in self._lasting]
            if len(others) > KEPT_MAPS:
                self._maps.pop(others[0])
        return known

    def _source(self, fault: PlacedFault) -> tuple[Camera, tuple[float, float]]:
        """The camera in whose pixels a place is given, and the place."""
        if fault.tracker_px is not None:
            return self.by.tracker, fault.tracker_px
        return self.by.monitor, fault.screen_px or (0.0, 0.0)

    # Called for each frame

    def sky_points(self, now: Sequence[Now], stars: Stars) -> tuple[FloatArray, list[AddedLight]]:
        """False stars and flashes that are fixed on the sky: their directions (n, 3), and their
        names and light.
        """
        vectors = []
        lights = []
        for active in now:
            fault = active.fault
            if not isinstance(fault, FalseStar | Flash) or _moves_with_camera(fault):
                continue
            vector = self._sky_vector(fault, stars)
            if vector is not None:
                vectors.append(vector)
                lights.append(self._added(fault, active.share))
        return np.reshape(vectors, (-1, 3)), lights

    def _sky_vector(self, fault: FalseStar | Flash, stars: Stars) -> FloatArray | None:
        """The direction (3,), ICRS, of a point that is fixed on the sky; None for a star that the
        bench does not have.
        """
        if not isinstance(fault, Flash) or (fault.hip is None and fault.star is None):
            return np.asarray(self.by.apparent(icrs_direction(fault)[None])[0])
        # A star too faint to show is among all of the bench's stars.
        for known in (stars, self.by.stars):
            places = self._places(known, fault)
            if len(places):
                return np.asarray(known.vectors[places[0]])
        return None

    def star_direction(self, fault: Fault) -> FloatArray | None:
        """The direction (3,), ICRS, of the star that a fault is about; None if it is about none."""
        star_rows = self._places(self.by.stars, fault)
        if len(star_rows):
            return np.asarray(self.by.stars.vectors[star_rows[0]])
        return None

    def _added(self, fault: PointLight, share: float = 1.0) -> AddedLight:
        """A point's name and light, of which a share is shown."""
        rate = self.light_e_per_s(fault) * share
        v_mag = float(magnitude(rate / self.by.v0_e_per_s(fault.bv_mag)))
        return AddedLight(fault.name, v_mag, fault.bv_mag, rate)

    def camera_points(
        self, now: Sequence[Now], scan: Scan | None
    ) -> "tuple[list[PointChain], list[AddedLight]]":
        """False stars and flashes that move with the camera, and tracks: chains, and the name
        and light of each line.
        """
        chains = []
        lights = []
        for active in now:
            fault = active.fault
            if isinstance(fault, FalseStar | Flash) and _moves_with_camera(fault):
                chains.append(self._moving(fault, active, scan))
                lights.append(self._added(fault, active.share))
            elif isinstance(fault, CosmicRays):
                burst = self._burst(fault, max(0, active.since_ns))
                chains.append(replace(burst, electrons_per_s=burst.electrons_per_s * active.share))
                rate = fault.electrons / self.by.exposure_s * active.share
                v_mag = float(magnitude(rate / self.by.v0_e_per_s(TRACK_BV_MAG)))
                lights += [AddedLight(fault.name, v_mag, TRACK_BV_MAG, rate)] * fault.number
        return chains, lights

    def _moving(self, fault: FalseStar | Flash, active: Now, scan: Scan | None) -> "PointChain":
        """A point's path over the pixels while they are lit."""
        canvas = self.by.canvas
        camera = canvas.camera
        source, place = self._source(fault)
        begin_px = np.array([place])
        rate_px_s = np.array(fault.rate_px_s)
        begin_s = active.since_ns / NS_PER_S
        hold_s = 0.0
        if scan is not None and rate_px_s.any():
            x_px, y_px = camera.pixels_from(source, *(begin_px + rate_px_s * begin_s).T)
            late_s = float(scan.late_s(x_px, y_px, camera.resolution_px)[0])
            if math.isfinite(late_s):
                begin_s += late_s
            hold_s = scan.hold_s
        first_px = begin_px + rate_px_s * begin_s
        last_px = begin_px + rate_px_s * (begin_s + hold_s)
        light = np.array([self.light_e_per_s(fault) * active.share])
        return Lines(first_px, last_px, light).seen_by(camera, source, canvas.psf)

    def _burst(self, fault: CosmicRays, since_ns: int) -> "PointChain":
        """The tracks of the exposure that a moment is in, counted from the burst's beginning."""
        by = self.by
        number = int(since_ns // round(by.exposure_s * NS_PER_S))
        key = (fault.name, number)
        if key not in self._tracks:
            if len(self._tracks) >= KEPT_BURSTS:
                self._tracks.clear()
            rng = self.rng(fault.name, TRACK_SEED, number)
            lines = tracks(fault, by.tracker.resolution_px, by.exposure_s, rng)
            self._tracks[key] = lines.seen_by(by.canvas.camera, by.tracker, by.canvas.psf)
        return self._tracks[key]

    def gone(self, now: Sequence[Now], stars: Stars) -> list[tuple[int, float]]:
        """Stars that a fault removes, and the share of their light that is left in this frame."""
        removed = []
        for active in now:
            if isinstance(active.fault, StarGone):
                for star in self._places(stars, active.fault):
                    removed.append((int(star), 1 - active.share))
        return removed

    def _places(self, stars: Stars, fault: Fault) -> IntArray:
        """The places of a fault's star in `stars`; empty if it is not among them, or the fault is
        about none.

        A bench's arrays keep their order for a whole run: each star is searched for once.
        """
        wanted = None
        if isinstance(fault, Flash | StarGone):
            wanted = fault.hip if fault.hip is not None else fault.star
        if wanted is None:
            return np.empty(0, dtype=np.intp)
        key = (id(stars.hip), wanted)
        known = self._found.get(key)
        if known is None:
            if len(self._found) >= KEPT_STARS:
                self._found.clear()
            # the array is kept, so that no other one has its id
            known = self._found[key] = (stars.hip, _places(stars, wanted))
        return known[1]

    def surfaces(
        self, now: Sequence[Now], q_icrs_to_cam: FloatArray
    ) -> list[extended.ExtendedLight]:
        """The stray light of the faults that are on."""
        surfaces: list[extended.ExtendedLight] = []
        for active in now:
            fault = active.fault
            if isinstance(fault, Glow):
                surfaces.append(self._glow(fault, active.share, q_icrs_to_cam))
            elif isinstance(fault, Gradient | MeasuredMap):
                light = self._map(fault)
                # the same object, by which the renderer recognises the same light
                if active.share != 1:
                    light = replace(light, times=light.times * active.share)
                surfaces.append(light)
        return surfaces

    def _glow(self, fault: Glow, share: float, q_icrs_to_cam: FloatArray) -> extended.GlowLight:
        fixed = fault.tracker_px is not None or fault.screen_px is not None
        known = self._glow_kept
        if fixed and known is not None and known[:2] == (fault, share):
            return known[2]  # the same object, by which the renderer recognises the same light
        by = self.by
        if fixed:
            source, (x_px, y_px) = self._source(fault)
            cam = source.rays(np.array([x_px]), np.array([y_px]))[0]
        else:
            cam = to_matrix(q_icrs_to_cam) @ by.apparent(icrs_direction(fault)[None])[0]
        direction = by.canvas.camera.cam_to_image @ cam
        # A monitor pixel collects as much of a tracker pixel's light as it covers of it.
        covered = (by.tracker.focal_length_px / by.canvas.camera.focal_length_px) ** 2
        peak = self.light_e_per_s(fault) * share * covered
        unit = direction / np.linalg.norm(direction)
        made = extended.GlowLight(
            unit,
            peak,
            math.radians(fault.scale_deg),
            fault.exponent,
            by.canvas.camera,
            fault.bv_mag,
        )
        if fixed:
            self._glow_kept = fault, share, made
        return made

    def footprints(self, chains: "list[PointChain]") -> list[FrameLight]:
        """The sprites of chains. Their lines are numbered from one chain to the next, as stars
        -1, -2 and on.
        """
        made = []
        first = 0
        for chain in chains:
            star = -1 - first - chain.line
            size_px = self.by.canvas.camera.resolution_px
            footprint_px = self.by.canvas.psf.footprint_px
            made.append(
                pack_sprites(
                    chain.x_px, chain.y_px, chain.electrons_per_s, star, size_px, footprint_px
                )
            )
            first += chain.lines
        return made


def icrs_direction(fault: PlacedFault) -> FloatArray:
    """The unit vector (3,), ICRS, of a place on the sky."""
    if fault.icrs is not None:
        vector = np.array(fault.icrs)
        return np.asarray(vector / np.linalg.norm(vector))
    return direction_of(*(fault.radec_deg or (0.0, 0.0)))


def _places(stars: Stars, wanted: int | str) -> IntArray:
    if isinstance(wanted, int):
        return np.flatnonzero(stars.hip == wanted)
    first = len(stars) - len(stars.bodies)
    if wanted in stars.bodies:
        return np.array([first + stars.bodies.index(wanted)])
    number = re.fullmatch(r"HIP (\d{1,9})", wanted)
    if number is not None:
        return np.flatnonzero(stars.hip == int(number[1]))
    hip = hip_named(wanted)
    if hip is not None:
        return np.flatnonzero(stars.hip == hip)
    identifier = stars.catalog.identifier_of(wanted)
    if identifier is None:
        return np.empty(0, dtype=np.intp)
    nameless = np.flatnonzero(stars.hip[:first] == 0)
    identifiers = stars.catalog.identifier[stars.row[nameless]]
    return np.asarray(nameless[identifiers == identifier], dtype=np.intp)


@dataclass(frozen=True, slots=True)
class PointChain:
    """Points of light (n,): pixels of a camera, electrons per second, and which of `lines` lines
    each is of.
    """

    x_px: FloatArray
    y_px: FloatArray
    electrons_per_s: FloatArray
    line: IntArray
    lines: int


@dataclass(frozen=True, slots=True)
class Lines:
    """Straight lines (n, 2) in pixels of a camera, each with its light, electrons per second
    (n,), evenly along it.
    """

    begin_px: FloatArray
    end_px: FloatArray
    electrons_per_s: FloatArray

    def seen_by(self, camera: Camera, source: Camera, psf: Psf) -> PointChain:
        """The lines in pixels of `source` as `camera` sees them; lines behind it or beyond its
        lens have no points.
        """
        begin_x, begin_y = camera.pixels_from(source, *self.begin_px.T)
        end_x, end_y = camera.pixels_from(source, *self.end_px.T)
        sigma_x, sigma_y = psf.width_px
        across_sigma = (end_x - begin_x) / sigma_x
        down_sigma = (end_y - begin_y) / sigma_y
        length_sigma = np.hypot(across_sigma, down_sigma)
        known = np.nan_to_num(length_sigma, nan=-1.0, posinf=-1.0)
        wanted = np.ceil(known / STEP_SIGMA)
        steps = np.minimum(wanted, MAX_STEPS - 1).astype(np.intp)
        counts = np.where(known < 0, 0, steps + 1)
        line = np.repeat(np.arange(len(counts)), counts)
        first = np.repeat(np.cumsum(counts) - counts, counts)
        # One point of a line that is none lies at its place; those of a longer one in the middles
        # of its equal parts.
        order = np.arange(len(line)) - first
        share = ((order + 0.5) / counts[line])[:, None]
        begin = self.begin_px[line]
        end = self.end_px[line]
        places = begin * (1 - share) + end * share
        x_px, y_px = camera.pixels_from(source, *places.T)
        light = self.electrons_per_s[line] / counts[line]
        return PointChain(x_px, y_px, light, line, len(counts))


def tracks(
    burst: CosmicRays, resolution_px: tuple[int, int], exposure_s: float, rng: np.random.Generator
) -> Lines:
    """The tracks of one exposure in tracker pixels: their middles anywhere on the detector, in
    any direction.
    """
    width, height = resolution_px
    middle = rng.random((burst.number, 2)) * (width, height) - 0.5
    angle = rng.uniform(0.0, 2 * np.pi, burst.number)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    half = burst.length_px / 2 * direction
    light = np.full(burst.number, burst.electrons / exposure_s)
    return Lines(middle - half, middle + half, light)


def _moves_with_camera(fault: FalseStar | Flash) -> bool:
    """Whether a point has a place in the tracker's or the screen's pixels."""
    return fault.tracker_px is not None or fault.screen_px is not None
