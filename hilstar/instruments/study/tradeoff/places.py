"""Trade-offs of place: culling, projection, smear along a turning star's path, prediction; on
the demo's bench.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.resources import resource_path
from hilstar.basics.rotation import angle_between_rad, normalise, to_matrix
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.display.geometry import monitor_camera
from hilstar.display.phases import measure
from hilstar.display.render.reference import linear_image
from hilstar.display.render.target import Target
from hilstar.display.render.variants import SplatVariant, VariantRenderer
from hilstar.instruments.study.predictors import (
    JITTER,
    NEAR,
    ORION,
    SLEW_DEG,
    SLEW_S,
    AttitudeAt,
    Predictor,
    predictors,
    slew_attitude,
    slew_sample,
)
from hilstar.instruments.study.trials import Figure, Trial, Trials
from hilstar.optics.camera import Camera
from hilstar.optics.exposure_motion import MIDDLE_S, Motion, smeared_sprites
from hilstar.optics.psf import GaussianPsf, Psf
from hilstar.optics.sprites import SPRITE_DTYPE, FrameLight, pack_sprites
from hilstar.server.bench.cameras import ideal_monitor, tracker_psf
from hilstar.server.bench.config import BenchConfig, RenderSettings, read_config
from hilstar.server.bench.star_light import bench_stars
from hilstar.sky.catalog import plain_catalog
from hilstar.sky.stars import CELL_DEG, Stars, cell_grid, make_stars

SPRITE_PSF = GaussianPsf(RenderSettings().sprite_sigma_px)
NO_LIMIT_V_MAG = 20.0  # fainter than all of Hipparcos
ATTITUDES = 60  # random fields
SEED = 1
STAR_COLUMNS = ("hip", "vectors", "v_mag", "bv_mag", "temperature_k", "electrons_per_s", "row")
CELLS_DEG = (1.0, 2.0, 3.0, 4.0, 6.0, 10.0, 20.0)
# float64 places of 2000 px are a few steps of 2.3e-13 px off.
ROUNDING_PX = 1e-12
SAMPLE_MS = 50  # between attitudes
FRAME_HZ = 60
PREDICTIONS = 60  # attitudes that are timed as one work
RATE_DEG_S = (0.7, -0.7, 5.0)
EVENLY = (4, 8, 16, 32, 64)
GAUSS = (8, 16, 24, 32)
# 200 nodes on 28 sigmas at most: six times as many as the module's rule asks for.
EXACT_NODES = 200
# Wider than the path's own footprints, so that the steps' error is not their cut; 24 px are 21
# sigma on either side.
WIDE_PX = 24
STARS_ACROSS = 16  # of a square grid
# float32 fluxes and fractions of the sprites: 6e-8 of each.
ROUNDING_SHARE = 1e-7
MARGIN_PX = SPRITE_PSF.footprint_px / 2 + 1  # beyond the image, from where sprites reach into it


@dataclass(frozen=True, slots=True)
class CulledStars:
    """The stars in view, as places (n,) in `Stars`, and how many were tested."""

    star: IntArray
    tested: int


Finder = Callable[[Stars, FloatArray, Camera], CulledStars]
SpritesOf = Callable[[Stars], FrameLight]


@dataclass(frozen=True, slots=True)
class Road:
    """From directions to sprites: the precision of the mathematics, and the layout of the
    sprites.
    """

    kind: type[np.floating[Any]]
    dtype: np.dtype[np.void]

    def pack(
        self, vectors: FloatArray, icrs_to_image: FloatArray, camera: Camera
    ) -> tuple[npt.NDArray[np.void], IntArray]:
        """Sprites of stars of one electron per second, in the layout, and which of `vectors`
        (n, 3) they are.
        """
        kind = self.kind
        turned = vectors.astype(kind, copy=False) @ icrs_to_image.T.astype(kind)
        x, y, z = turned.T
        scale = kind(camera.focal_length_px) / z
        centre_x, centre_y = camera.principal_point_px
        x = x * scale + kind(centre_x)
        y = y * scale + kind(centre_y)
        star = np.arange(len(vectors))
        width, height = camera.resolution_px
        side_px = SPRITE_PSF.footprint_px
        if self.dtype == SPRITE_DTYPE:
            sprites = pack_sprites(x, y, np.ones(len(star)), star, (width, height), side_px)
            return sprites.data, sprites.star
        margin = side_px / 2
        is_visible = (x > -margin) & (x < width + margin)
        is_visible &= (y > -margin) & (y < height + margin)
        data = np.empty(np.count_nonzero(is_visible), dtype=self.dtype)
        data["place_px"][:, 0] = x[is_visible]
        data["place_px"][:, 1] = y[is_visible]
        data["electrons_per_s"] = 1.0
        return data, star[is_visible]

    def places_px(
        self, vectors: FloatArray, icrs_to_image: FloatArray, camera: Camera
    ) -> npt.NDArray[np.longdouble]:
        """Places (n, 2) of the stars, px; NaN for one that is not seen."""
        data, star = self.pack(vectors, icrs_to_image, camera)
        places = np.full((len(vectors), 2), np.nan, dtype=np.longdouble)
        if data.dtype == SPRITE_DTYPE:
            places[star] = data["pixel"] + data["fraction_px"].astype(np.longdouble)
        else:
            places[star] = data["place_px"]
        return places


def _layout(place: type[np.floating[Any]]) -> np.dtype[np.void]:
    return np.dtype([("place_px", place, 2), ("electrons_per_s", "<f4")])


EXACT: Road = Road(np.longdouble, _layout(np.longdouble))
ROADS: dict[str, Road] = {
    "extended precision": EXACT,
    "float64, place in float64": Road(np.float64, _layout(np.float64)),
    "float64, place in float32": Road(np.float64, _layout(np.float32)),
    "float32 throughout": Road(np.float32, _layout(np.float32)),
    "float64, whole pixel + float32 fraction": Road(np.float64, SPRITE_DTYPE),
}


@cache
def demo_config() -> BenchConfig:
    """The bench of `hilstar demo`."""
    return read_config(resource_path("configs", "demo.toml"))


@cache
def stars_to(faintest_v_mag: float) -> Stars:
    """The demo's stars to a magnitude."""
    config = demo_config()
    sky = msgspec.structs.replace(config.sky, faintest_v_mag=faintest_v_mag)
    return bench_stars(msgspec.structs.replace(config, sky=sky), Path())


def turn_to_image(q: FloatArray, camera: Camera) -> FloatArray:
    """ICRS to image axes, (3, 3), at an attitude."""
    return np.asarray(camera.cam_to_image @ to_matrix(q))


def random_turns(count: int, camera: Camera) -> list[FloatArray]:
    """Rotations from ICRS to image axes, (3, 3) each: ORION's, then uniformly random ones."""
    random_q = normalise(np.random.default_rng(SEED).normal(size=(count - 1, 4)))
    return [turn_to_image(q, camera) for q in (ORION, *random_q)]


def in_cells(stars: Stars, cell_deg: float, by_centres: bool = False) -> Stars:
    """The stars in cells of another size; `by_centres` takes a cell for a point."""
    grid = cell_grid(stars.vectors, cell_deg)
    columns = {name: getattr(stars, name)[grid.order] for name in STAR_COLUMNS}
    if by_centres:
        cosine = np.ones_like(grid.cos_radius)
        sine = np.zeros_like(grid.sin_radius)
        grid = replace(grid, cos_radius=cosine, sin_radius=sine)
    return replace(stars, **columns, grid=grid)


def scan(stars: Stars, turn: FloatArray, camera: Camera) -> CulledStars:
    """Every star projected."""
    every = np.arange(len(stars))
    return CulledStars(projected(stars, every, turn, camera), len(stars))


def by_angle(stars: Stars, turn: FloatArray, camera: Camera) -> CulledStars:
    """The stars within a circle about the boresight, by the angles of all stars."""
    radius_rad = camera.field_radius_rad(MARGIN_PX)
    near = np.flatnonzero(stars.vectors @ turn[2] >= np.cos(radius_rad))
    return CulledStars(projected(stars, near, turn, camera), len(stars))


def by_cells(stars: Stars, turn: FloatArray, camera: Camera) -> CulledStars:
    """As `make_sprites` finds them."""
    radius_rad = camera.field_radius_rad(MARGIN_PX)
    near = stars.grid.near(turn[2], radius_rad, camera.edges(MARGIN_PX) @ turn)
    return CulledStars(projected(stars, near, turn, camera), len(near))


def projected(stars: Stars, near: IntArray, turn: FloatArray, camera: Camera) -> IntArray:
    """The stars of `near` (n,) that are in view."""
    x_px, y_px = camera.project(stars.vectors[near] @ turn.T)
    rates = stars.electrons_per_s[near]
    side_px = SPRITE_PSF.footprint_px
    return pack_sprites(x_px, y_px, rates, near, camera.resolution_px, side_px).star


def culling(stack: ExitStack, quick: bool) -> Trials:
    """How the stars in view are found: stars missed over ATTITUDES fields, and stars tested in
    vain.
    """
    del stack
    camera = ideal_monitor(demo_config())
    stars = stars_to(NO_LIMIT_V_MAG)
    turns = random_turns(10 if quick else ATTITUDES, camera)
    in_view = [set(stars.hip[scan(stars, turn, camera).star].tolist()) for turn in turns]
    methods: dict[str, tuple[Stars, Finder]] = {
        "scan, every star projected": (stars, scan),
        "scan of angles": (stars, by_angle),
    }
    for cell_deg in sorted({*CELLS_DEG, CELL_DEG}):
        methods[f"cells of {cell_deg:g} deg"] = in_cells(stars, cell_deg), by_cells
    by_centres = in_cells(stars, 10.0, by_centres=True)
    methods["cells of 10 deg, by centres only"] = by_centres, by_cells
    trials = []
    for name, (sorted_stars, finder) in methods.items():
        missed = 0
        vain = 0
        for turn, wanted in zip(turns, in_view, strict=True):
            culled = finder(sorted_stars, turn, camera)
            shown = set(sorted_stars.hip[culled.star].tolist())
            missed += len(wanted - shown)
            vain += culled.tested - len(wanted & shown)
        work = partial(finder, sorted_stars, turns[0], camera)
        is_default = name == f"cells of {CELL_DEG:g} deg"
        trials.append(Trial(name, missed, vain / len(turns), work, is_default, finder is scan))
    return Trials(
        "culling",
        f"{len(stars)} stars to the {len(in_view[0])} sprites of Orion",
        Figure(f"stars missed in {len(turns)} fields", "stars", 0.1),
        Figure("tested but not in view, mean", "stars"),
        "a smaller cell passes on fewer stars in a rich field, a larger one costs less in a"
        " sparse one",
        trials,
    )


def projection(stack: ExitStack, quick: bool) -> Trials:
    """Errors of star places, px, by number format: largest and rms over the stars of ATTITUDES
    fields.
    """
    del stack
    camera = ideal_monitor(demo_config())
    stars = stars_to(NO_LIMIT_V_MAG)
    turns = random_turns(6 if quick else ATTITUDES, camera)
    radius_rad = camera.field_radius_rad(0.0)
    near = [stars.vectors[stars.grid.near(turn[2], radius_rad)] for turn in turns]

    def places(road: Road) -> npt.NDArray[np.longdouble]:
        of_fields = []
        for vectors, turn in zip(near, turns, strict=True):
            of_fields.append(road.places_px(vectors, turn, camera))
        return np.concatenate(of_fields)

    truth = places(EXACT)
    trials = []
    for name, road in ROADS.items():
        off_x, off_y = (places(road) - truth).T
        error = np.hypot(off_x, off_y).astype(np.float64)
        error = error[np.isfinite(error)]
        rms_px = float(np.sqrt(np.mean(error**2)))
        work = partial(road.pack, near[0], turns[0], camera)
        # The sprites' own layout says which of them the renderer is handed.
        is_default = road.dtype == SPRITE_DTYPE
        trials.append(Trial(name, float(error.max()), rms_px, work, is_default, road is EXACT))
    width, height = camera.resolution_px
    return Trials(
        "projection",
        f"{len(near[0])} stars near the field to sprites, {width} x {height}",
        Figure("position error, worst star", "px", ROUNDING_PX),
        Figure("rms", "px"),
        "OpenGL 3.3 takes no float64, and the error of a float32 position grows with the monitor",
        trials,
    )


@dataclass(frozen=True, slots=True)
class SmearBench:
    """The demo's tracker as a display of its own pixels, and a turn of its camera."""

    camera: Camera
    psf: Psf
    motion: Motion

    @property
    def side_px(self) -> int:
        """The side of the detector."""
        return self.camera.resolution_px[0]

    def path_sprites(self, stars: Stars) -> FrameLight:
        """Stars along their paths, as hilstar draws them."""
        return smeared_sprites(stars, self.motion, self.camera, self.psf)

    def chain(self, at: FloatArray, share: FloatArray, stars: Stars) -> FrameLight:
        """Stars at the parts `at` (k,) of the exposure with shares (k,) of their light; 0 is its
        middle.
        """
        x_px, y_px = self.places_px(stars, at)
        light = np.outer(share, stars.electrons_per_s).ravel()
        star = np.tile(np.arange(len(stars)), len(at))
        size_px = self.camera.resolution_px
        side_px = self.psf.footprint_px
        return pack_sprites(x_px.ravel(), y_px.ravel(), light, star, size_px, side_px)

    def places_px(self, stars: Stars, at: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places (k, n), px, at the parts `at` (k,) of the exposure; 0 is its middle."""
        turns = self.motion.icrs_to_image(at * self.motion.exposure_s, self.camera)
        directions = stars.vectors @ turns.transpose(0, 2, 1)
        x_px, y_px = self.camera.project(directions.reshape(-1, 3))
        return x_px.reshape(len(at), -1), y_px.reshape(len(at), -1)

    def image(self, sprites: FrameLight) -> FloatArray:
        """The exact linear image (h, w)."""
        return linear_image(sprites, self.camera.resolution_px, self.psf, WIDE_PX)

    def grid_stars(self, across: int) -> Stars:
        """Stars of one electron per second, across^2 of them evenly over the detector in the middle
        of the exposure.
        """
        count = across**2
        place = (np.arange(across) + 0.5) * self.side_px / across - 0.5
        columns, rows = np.meshgrid(place, place)
        x_px = columns.ravel() - (self.side_px - 1) / 2
        y_px = rows.ravel() - (self.side_px - 1) / 2
        image = np.column_stack([x_px, y_px, np.full(count, self.camera.focal_length_px)])
        directions = image / np.linalg.norm(image, axis=1, keepdims=True)
        vectors = directions @ self.motion.icrs_to_image(MIDDLE_S, self.camera)[0]
        zero = np.zeros(count)
        catalog = plain_catalog("star", count, {"v_mag": zero, "ra_deg": zero, "dec_deg": zero})
        return make_stars(catalog, vectors, zero, zero + 1)


def smear_bench() -> SmearBench:
    """The demo's tracker at RATE_DEG_S."""
    tracker = demo_config().tracker
    aligned = np.array([1.0, 0, 0, 0])
    camera = monitor_camera(
        tracker.resolution_px, tracker.pixel_pitch_um, tracker.focal_length_mm, aligned
    )
    motion = Motion(ORION, np.radians(np.array(RATE_DEG_S)), tracker.exposure_s)
    return SmearBench(camera, tracker_psf(tracker, Path()), motion)


def smear_methods(bench: SmearBench) -> dict[str, SpritesOf]:
    """Every fixed number of sprites on a path, by Gauss-Legendre quadrature and evenly in time."""
    methods: dict[str, SpritesOf] = {}
    for count in (*GAUSS, EXACT_NODES):
        nodes, weights = np.polynomial.legendre.leggauss(count)
        methods[gauss_name(count)] = partial(bench.chain, nodes / 2, weights / 2)
    for count in EVENLY:
        at = (np.arange(count) + 0.5) / count - 0.5
        share = np.full(count, 1 / count)
        methods[f"evenly in time, {count}"] = partial(bench.chain, at, share)
    return methods


def gauss_name(count: int) -> str:
    """The name of so many nodes of quadrature."""
    return f"Gauss-Legendre, {count}"


def smear(stack: ExitStack, quick: bool) -> Trials:
    """Sprites on a turning star's path: worst pixel, share of the star's flux, and centroid, px,
    over a grid of stars.
    """
    across = STARS_ACROSS // 2 if quick else STARS_ACROSS
    bench = smear_bench()
    few = bench.grid_stars(across)
    many = bench.grid_stars(STARS_ACROSS)
    target = Target(bench.camera.resolution_px, bench.psf)
    renderer = stack.enter_context(VariantRenderer(target, SplatVariant()))

    def draw(sprites_of: SpritesOf) -> None:
        renderer.draw_and_wait(sprites_of(many))

    mean_count = len(bench.path_sprites(few)) / len(few)
    default = f"Gauss-Legendre by length, {mean_count:.0f} on average"
    methods = {default: bench.path_sprites, **smear_methods(bench)}
    exact = bench.image(methods[gauss_name(EXACT_NODES)](few))
    trials = []
    for name, sprites_of in methods.items():
        drawn = bench.image(sprites_of(few))
        worst = float(np.abs(drawn - exact).max())
        off_px = measure(exact, drawn, len(exact) // across).centroid_max_px
        work = partial(draw, sprites_of)
        is_exact = name == gauss_name(EXACT_NODES)
        trials.append(Trial(name, worst, off_px, work, name == default, is_exact))
    x_px, y_px = bench.places_px(many, np.array([-0.5, 0.5]))
    paths_px = np.hypot(np.diff(x_px, axis=0), np.diff(y_px, axis=0))
    extent = f"{paths_px.min():.0f} to {paths_px.max():.0f} px"
    return Trials(
        "smear",
        f"linear image of {len(many)} stars, paths of {extent}, {bench.side_px} px squared",
        Figure("largest pixel error, share of its star", "1", ROUNDING_SHARE),
        Figure("centre of gravity, worst", "px"),
        "its error does not grow with the path, as that of a fixed number does",
        trials,
    )


def prediction_errors(predictor: Predictor, samples: Sequence[AttitudeSample]) -> list[float]:
    """The errors of a predictor in every frame between its samples, arcsec."""
    frame_ns = NS_PER_S / FRAME_HZ
    errors = []
    for after in range(NEAR, len(samples)):
        # One that waits has the sample after the frame, too.
        end = after + 1 if predictor.waits else after
        attitude_at = predictor.load(samples[after - NEAR : end])
        first = math.ceil(samples[after - 1].t_ns / frame_ns)
        last = math.ceil(samples[after].t_ns / frame_ns)
        for number in range(first, last):
            t_ns = round(number * frame_ns)
            off_rad = angle_between_rad(slew_attitude(t_ns), attitude_at(t_ns))
            errors.append(off_rad * math.degrees(3600))
    return errors


def attitudes_at(attitude_at: AttitudeAt, times_ns: Sequence[int]) -> None:
    """The work that is timed."""
    for t_ns in times_ns:
        attitude_at(t_ns)


def prediction(stack: ExitStack, quick: bool) -> Trials:
    """The attitude at the moment of light, after the newest sample: worst and rms error, arcsec,
    on a shaken slew.
    """
    del stack
    seconds = 10 if quick else 60
    count = seconds * 1000 // SAMPLE_MS
    samples = [slew_sample(k * SAMPLE_MS * NS_PER_MS) for k in range(count)]
    after_ns = np.linspace(0, SAMPLE_MS * NS_PER_MS, PREDICTIONS, dtype=np.int64)
    times_ns = (after_ns + samples[-2].t_ns).tolist()
    trials = []
    for predictor in predictors():
        errors = prediction_errors(predictor, samples)
        end = len(samples) if predictor.waits else -1
        attitude_at = predictor.load(samples[-1 - NEAR : end])
        work = partial(attitudes_at, attitude_at, times_ns)
        rms_arcsec = float(np.sqrt(np.mean(np.square(errors))))
        trials.append(Trial(predictor.name, max(errors), rms_arcsec, work, predictor.is_default))
    shaken = ", ".join(f"{size:g} arcsec at {hz:g} Hz" for size, hz in JITTER)
    return Trials(
        "prediction",
        f"{PREDICTIONS} attitudes, samples every {SAMPLE_MS} ms",
        Figure("attitude error, worst", "arcsec"),
        Figure("rms", "arcsec"),
        "it needs nothing but the newest sample",
        trials,
        f"a swing of {SLEW_DEG:g} degrees in {SLEW_S:g} s, shaken on each axis by {shaken}; waiting"
        f" for a sample makes the attitude {SAMPLE_MS} ms older; the times of hold, of the linear"
        " predictors and of the blend include the timeline, those of the other two do not",
    )
