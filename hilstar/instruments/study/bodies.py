"""The study of bodies: the cost of each in a frame, the accuracy of its disc at each size, and its
approach.

Each body is alone on its bench; its cost is the difference from the same frame without bodies. A
disc is compared with rays traced in float64 and with a point in its place. An approaching body is
judged by frame time and by finite light.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from hilstar.basics.arrays import Float32Array, FloatArray
from hilstar.basics.charts import (
    BLUE,
    MUTED,
    capital,
    chart,
    value_bars,
)
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.basics.units import NS_PER_S
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import Target
from hilstar.display.response import Levels
from hilstar.instruments.study.engine import (
    HIDDEN,
    ChartSpec,
    LevelLine,
    LineSpec,
    PanelSpec,
    at_least,
    draw_rows,
    looks_of,
    write_rows,
)
from hilstar.instruments.study.study_benches import FULL_HD, Table, study_bench
from hilstar.instruments.study.sweep import Judged, Load, OtherWork, Spent, in_turn
from hilstar.optics.camera import Camera
from hilstar.optics.extended import DiscView, Pose, disc_lights
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.sprites import join_sprites, pack_sprites
from hilstar.server.bench.frame import Bench
from hilstar.sky.bodies.disc import Disc
from hilstar.sky.bodies.shapes import lunar_share

REFRESH_HZ = 60.0
EPOCH: Table = {"epoch_utc": "2026-11-21T00:00:00Z"}
# 400 km over a circle, made for that date
TLE = """\
1 99999U          26325.00000000  .00000000  00000-0  00000+0 0    05
2 99999  51.6000 150.0000 0001000   0.0000   0.0000 15.55820000    02
"""
DAY_SIDE_NS = 24 * 60 * NS_PER_S  # the Sun is 72 degrees from its zenith then
LOW_ORBIT: Table = {"orbit": "low.tle"}
GEOCENTRE: Table = {"orbit": "geocentre"}
# By the name of a bench: its bodies and its observer
BODIES: dict[str, tuple[Table, Table]] = {
    "nothing": ({}, {}),
    "observer": ({}, GEOCENTRE),
    "low orbit": ({}, LOW_ORBIT),
    "planets": ({"planets": True}, GEOCENTRE),
    "Moon": ({"moon": True}, GEOCENTRE),
    "Sun": ({"sun": True}, GEOCENTRE),
    "Earth": ({"earth": True}, LOW_ORBIT),
    "all": ({"planets": True, "moon": True, "sun": True, "earth": True}, LOW_ORBIT),
}
FRAME_NS = round(NS_PER_S / REFRESH_HZ)
SIGMA_PX = (0.85, 0.85)  # of sprites by default
MIDDLE_PX = (0.2, -0.3)  # disc centre from the middle pixel's centre: off any symmetry
FOCAL_PX = 6000.0  # a pixel is 34 arcsec, as on the demo's monitor
RADII_PX = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0, 6.0, 8.0, 12.0, 20.0, 40.0, 80.0)
QUICK_RADII_PX = (0.1, 2.0, 12.0)
PHASES_DEG = (0.0, 60.0, 120.0, 150.0)
# along each side: at most 0.07 px apart, under a tenth of sigma
MIN_RAYS, RAYS_A_PX, MAX_RAYS = 600, 16, 2400
LIMB_PX = 4.0  # a smaller disc has no edge that falls from a middle
PLACES = 60  # along a limb, where its edge is found
MARGIN_PX = 8  # around a disc: nine sigmas of its light
# Degrees from the boresight to the body's middle, of the Earth beyond its limb (negative: on it)
NEAR_DEG: dict[str, tuple[float, ...]] = {
    "Moon": (40.0, 20.0, 12.0, 8.0, 5.0, 3.0, 1.0, 0.5, 0.25, 0.0),
    "Sun": (40.0, 20.0, 12.0, 8.0, 5.0, 3.0, 1.0, 0.5, 0.25, 0.0),
    "Earth": (40.0, 20.0, 12.0, 8.0, 5.0, 3.0, 1.0, 0.0, -1.0, -3.0, -8.0, -20.0, -40.0, -70.0),
}
QUICK_DEG: dict[str, tuple[float, ...]] = {
    "Moon": (40.0, 0.5),
    "Sun": (40.0, 0.5),
    "Earth": (40.0, 0.0, -70.0),
}
ROUNDS, QUICK_ROUNDS = 40, 3  # of which the fastest frame counts
QUICK_BENCHES = ("nothing", "Moon", "Sun", "Earth", "all")
FLUX_LIMIT, LIMB_LIMIT_PX = 0.01, 0.1
DISC_PX = 0.2  # a body of a smaller diameter is drawn as a point
FLOOR = 1e-6  # lower end of the chart's axis
SMALL = {"ms": 4}
BESIDE_AXIS = (0.3, 1.0, 0.0)  # the Sun stands beside a disc, across this axis
SIZE_NOTE = (
    f"A Moon at {len(PHASES_DEG)} phases, against rays in float64. Left of the dashed line it is"
    " drawn as a point."
)
LOG_LOG: Any = {"scales": ("log", "log")}
LIMIT_NOTE = (
    "Earth by its limb, negative on the Earth; Moon and Sun by their middles. 1920 x 1080, drawn in"
    " software."
)
LIMIT_TICKS_DEG = (-70, -20, -8, -3, -1, 0, 1, 3, 8, 20, 40)
# The panels share an x axis, which is the lower one's.
LIMIT_PANELS = (
    PanelSpec(
        (LineSpec("off_deg", "cpu_ms", marker="o", look=SMALL),),
        "processor time of a frame [ms]",
        levels=(LevelLine(1e3 / REFRESH_HZ, f"{REFRESH_HZ:g} Hz"),),
        from_zero=True,
    ),
    PanelSpec(
        (LineSpec("off_deg", "over_white_mag", marker="o", look=SMALL),),
        "brightest pixel over white [mag]",
        "angle from the boresight [deg]",
        levels=(LevelLine(0, "white"),),
        scales=("symlog", "linear"),
        xticks=LIMIT_TICKS_DEG,
    ),
)
COST_NOTE = (
    "Processor time of a frame, less that of the same frame on a bench without bodies; 1920 x"
    " 1080, drawn in software."
)


@contextmanager
def opened(names: tuple[str, ...]) -> Iterator[dict[str, Bench]]:
    """Open the benches of these names; they close with the context. Raises InputError or
    MachineError.
    """
    common: dict[str, Table] = {
        "tracker": {"resolution_px": (1024, 1024)},
        "monitor": {**FULL_HD, "refresh_hz": REFRESH_HZ, "bits": 12},
        "collimator": {"focal_length_mm": 350.0},
        "sky": EPOCH,
        "render": {"quantisation": "round", "motion": "off", "brightest_v_mag": 2.0},
    }
    with TemporaryDirectory() as folder, ExitStack() as stack:
        orbit = Path(folder) / "low.tle"
        orbit.write_text(TLE)
        benches = {}
        for name in names:
            tables = dict(common)
            bodies, spacecraft = BODIES[name]
            if bodies:
                tables["sky.bodies"] = bodies
            if spacecraft:
                tables["spacecraft"] = spacecraft
            file_name = name.replace(" ", "_")
            path = Path(folder) / f"{file_name}.toml"
            benches[name] = stack.enter_context(study_bench(path, tables))
        yield benches


def attitude(bench: Bench, body: str, off_deg: float, t_ns: int) -> FloatArray:
    """The attitude (unit quaternion) that points `off_deg` away from a body's centre.

    Of the Earth the angle counts from its limb, and is negative on its disc.
    """
    if bench.moving is None:
        raise AssertionError("a bench with bodies moves")
    north = np.array([0.0, 0.0, 1.0])
    discs = bench.moving.discs(north, np.pi, 0.0, t_ns)
    disc = next(disc for disc in discs if disc.name == body)
    off_rad = np.radians(off_deg)
    if body == "Earth":
        off_rad += disc.radius_rad
        # towards the Sun, where the limb is lit
        beside = disc.sun
    else:
        # along declination, away from the near pole
        beside = north * (-np.sign(disc.direction[2]) or 1.0)
    along_direction = (beside @ disc.direction) * disc.direction
    across = beside - along_direction
    across /= np.linalg.norm(across)
    towards = np.cos(off_rad) * disc.direction + np.sin(off_rad) * across
    x, y, z = towards
    ra_deg = float(np.degrees(np.arctan2(y, x)))
    dec_deg = float(np.degrees(np.arcsin(z)))
    return from_radec_roll_deg(ra_deg, dec_deg, 0.0)


@dataclass(frozen=True, slots=True)
class BodyScene:
    """What a frame shows: a bench by its name, and its aim `off_deg` from a body (see `attitude`).

    The bench's clock starts at `t_ns` and advances by `step_ns` a frame.
    """

    name: str
    bench: str
    body: str
    off_deg: float
    t_ns: int = 0
    step_ns: int = FRAME_NS


def at_a_step(scene: str) -> bool:
    """Whether every frame of a scene begins a new step of the orbit."""
    by_name = {known.name: known for known in SCENES}
    return by_name[scene].step_ns != FRAME_NS


@dataclass(frozen=True, slots=True)
class BodyCost:
    """The cost of the bodies in one scene: the fastest frame, ms, with and without them.

    `cpu_ms` is the difference in processor time of all cores, the driver's threads included. A busy
    machine changes it least, and in software rendering it is the whole cost. `discs` names the
    bodies that are drawn as discs, `stars` counts the stars drawn.
    """

    scene: str
    frame_ms: float
    without_ms: float
    cost_ms: float
    cpu_ms: float
    discs: str
    stars: int


SCENES: tuple[BodyScene, ...] = (
    BodyScene("from the Earth's centre, no body", "observer", "Moon", 60.0),
    BodyScene("planets, none in view", "planets", "Jupiter", 60.0),
    BodyScene("Uranus in view, a point", "planets", "Uranus", 0.3),
    BodyScene("Jupiter in view, 1.1 px", "planets", "Jupiter", 0.3),
    BodyScene("Moon, not in view", "Moon", "Moon", 60.0),
    BodyScene("Moon in view, 55 px", "Moon", "Moon", 0.3),
    BodyScene("Sun, not in view", "Sun", "Sun", 60.0),
    BodyScene("Sun in view, 57 px", "Sun", "Sun", 0.3),
    BodyScene("from a low orbit, no body", "low orbit", "Earth", 80.0, DAY_SIDE_NS),
    BodyScene("Earth, not in view", "Earth", "Earth", 80.0, DAY_SIDE_NS),
    BodyScene("Earth's limb across the middle", "Earth", "Earth", 0.0, DAY_SIDE_NS),
    BodyScene("Earth fills the field", "Earth", "Earth", -60.0, DAY_SIDE_NS),
    BodyScene("all of them, none in view", "all", "Earth", 80.0, DAY_SIDE_NS),
    BodyScene("the same, at a step of the orbit", "all", "Earth", 80.0, DAY_SIDE_NS, 2 * NS_PER_S),
)


def measure_cost(benches: Mapping[str, Bench], scene: BodyScene, rounds: int) -> BodyCost:
    """Time a scene and the same frame without bodies in turn.

    `benches` holds "nothing", "all" and the scene's own.
    """
    bench = benches[scene.bench]
    q = attitude(aiming_bench(benches, scene), scene.body, scene.off_deg, scene.t_ns)
    empty = benches["nothing"]
    without, shown = fastest((empty, bench), q, scene.t_ns, scene.step_ns, rounds)
    view = bench.view(q, None, scene.t_ns)
    cost_ms = shown.wall_ms - without.wall_ms
    cpu_ms = shown.cpu_ms - without.cpu_ms
    discs = " ".join(disc.name for disc in bench.discs(view))
    stars = bench.draw(q, t_ns=scene.t_ns).star_count
    return BodyCost(
        scene=scene.name,
        frame_ms=shown.wall_ms,
        without_ms=without.wall_ms,
        cost_ms=cost_ms,
        cpu_ms=cpu_ms,
        discs=discs,
        stars=stars,
    )


def aiming_bench(benches: Mapping[str, Bench], scene: BodyScene) -> Bench:
    """The bench that knows where a scene's body is: the scene's own, or that of all bodies."""
    bench = benches[scene.bench]
    if bench.moving is None or scene.body not in bench.moving.names:
        return benches["all"]
    return bench


def fastest(
    benches: tuple[Bench, Bench], q: FloatArray, t_ns: int, step_ns: int, rounds: int
) -> tuple[Spent, Spent]:
    """The fastest frame, from attitude to levels in memory, of a bench without bodies and of one
    with, timed in turn.

    The second bench's clock begins at `t_ns` and goes on by `step_ns` from frame to frame.
    """
    times = in_turn(frame_works(benches, q, t_ns, step_ns), rounds)
    return shortest(times["nothing"]), shortest(times["bodies"])


def frame_works(
    benches: tuple[Bench, Bench], q: FloatArray, t_ns: int, step_ns: int
) -> dict[str, Callable[[int], Levels]]:
    """The levels of a frame without bodies, and of one with, by the number of its round."""
    nothing, shown = benches

    def without(_: int) -> Levels:
        return nothing.draw(q).levels

    def with_bodies(number: int) -> Levels:
        return shown.draw(q, t_ns=t_ns + number * step_ns).levels

    return {"nothing": without, "bodies": with_bodies}


def shortest(times: Sequence[Spent]) -> Spent:
    """The smallest wall time and the smallest processor time of some frames."""
    wall_ms, cpu_ms = np.min(times, axis=0).tolist()
    return Spent(wall_ms, cpu_ms)


@dataclass(frozen=True, slots=True)
class Exactness:
    """How exact a disc of one radius at one phase is.

    `flux_off` is relative to its light, `pixel_off` to its brightest pixel; `point_pixel_off` is
    the error of a point drawn in its place. `limb_off_px` is NaN where the disc is too small or too
    thin to have a limb.
    """

    body: str
    phase_deg: float
    radius_px: float
    flux_off: float
    middle_off_px: float
    limb_off_px: float
    pixel_off: float
    point_pixel_off: float


def moon(radius_px: float, phase_deg: float) -> Disc:
    """A Moon of a radius and phase, off the centre of an image."""
    ahead = middle_direction()
    side = np.cross(ahead, BESIDE_AXIS)
    side /= np.linalg.norm(side)
    phase = np.radians(phase_deg)
    radius_rad = radius_px / FOCAL_PX
    sun = -np.cos(phase) * ahead + np.sin(phase) * side
    pole = np.array([0.0, 1.0, 0.0])
    disc = Disc(
        name="Moon",
        direction=ahead,
        distance_km=1 / np.sin(radius_rad),
        equator_km=1.0,
        polar_km=1.0,
        pole=pole,
        sun=sun,
        law="lunar-lambert",
        normal_e_per_s_sr=1.0,
        lunar_share=lunar_share(phase_deg),
    )
    return disc.of_rate(1e6)


def middle_direction() -> FloatArray:
    """The unit vector to the disc's centre."""
    x = MIDDLE_PX[0] / FOCAL_PX
    y = MIDDLE_PX[1] / FOCAL_PX
    ahead = np.array([x, y, 1.0])
    return np.asarray(ahead / np.linalg.norm(ahead))


def drawn_discs(disc: Disc, camera: Camera) -> tuple[FloatArray, FloatArray]:
    """The images (h, w) of a disc as it is drawn, and of a point in its place."""
    psf = GaussianPsf(SIGMA_PX)
    size_px = camera.resolution_px
    target = Target(size_px, psf)
    with Renderer(target) as renderer:
        x_px, y_px = camera.project(disc.direction[None])
        star = np.zeros(1, dtype=np.intp)
        side_px = renderer.footprint_px
        rate = np.array([1e6])
        point = pack_sprites(x_px, y_px, rate, star, size_px, side_px)
        pose = Pose(np.eye(3))
        view = DiscView(camera, psf, (pose,))
        lights = tuple(disc_lights(disc, view, covers=True))
        nothing = join_sprites([], side_px)
        renderer.draw(replace(nothing, extended=lights))
        as_disc = renderer.linear().astype(np.float64)
        renderer.draw(point)
        as_point = renderer.linear().astype(np.float64)
    return as_disc, as_point


def exactness(radius_px: float, phase_deg: float) -> Exactness:
    """The errors of a Moon as it is drawn, against traced rays."""
    from scipy.ndimage import center_of_mass

    disc = moon(radius_px, phase_deg)
    half = int(np.ceil(radius_px)) + MARGIN_PX
    side_px = 2 * half + 1
    camera = Camera((side_px, side_px), FOCAL_PX, (half, half), np.eye(3))
    drawn, as_point = drawn_discs(disc, camera)
    truth = traced(disc, camera)
    brightest = truth.max()
    limb_px = np.nan
    if radius_px >= LIMB_PX and phase_deg <= 90:
        true_edges_px = edges_px(truth, radius_px, phase_deg)
        drawn_edges_px = edges_px(drawn, radius_px, phase_deg)
        off_px = drawn_edges_px - true_edges_px
        limb_px = float(np.nanmax(np.abs(off_px)))
    middle_px = np.subtract(center_of_mass(drawn), center_of_mass(truth))
    flux_off = float(drawn.sum() / truth.sum() - 1)
    pixel_off = np.abs(drawn - truth).max()
    point_pixel_off = np.abs(as_point - truth).max()
    middle_off_px = float(np.abs(middle_px).max())
    return Exactness(
        body=disc.name,
        phase_deg=phase_deg,
        radius_px=radius_px,
        flux_off=flux_off,
        middle_off_px=middle_off_px,
        limb_off_px=limb_px,
        pixel_off=float(pixel_off / brightest),
        point_pixel_off=float(point_pixel_off / brightest),
    )


def traced(disc: Disc, camera: Camera) -> FloatArray:
    """The image (h, w) of a disc by float64 rays on a lattice, each spread over pixels by the
    Gaussian.
    """
    from scipy.special import ndtr

    limb_tangent = np.tan(disc.radius_rad)
    radius_px = limb_tangent * camera.focal_length_px * 1.001
    rays_across = RAYS_A_PX * 2 * radius_px
    count = int(np.clip(rays_across, MIN_RAYS, MAX_RAYS))
    step_px = 2 * radius_px / count
    along = (np.arange(count) + 0.5) * step_px - radius_px
    (x_mid,), (y_mid,) = camera.project(disc.direction[None])
    x_px, y_px = np.meshgrid(x_mid + along, y_mid + along)
    rays = camera.rays(x_px.ravel(), y_px.ravel())
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    # The solid angle of a square of the image plane: the cube of the ray's cosine to the axis
    step_rad = step_px / camera.focal_length_px
    solid_angle = step_rad**2
    light = disc.radiance(rays) * solid_angle * rays[:, 2] ** 3
    width, height = camera.resolution_px
    x_edges = edges_in_sigmas(width, x_mid + along, SIGMA_PX[0])
    across = np.diff(ndtr(x_edges), axis=1)
    y_edges = edges_in_sigmas(height, y_mid + along, SIGMA_PX[1])
    down = np.diff(ndtr(y_edges), axis=1)
    lattice = light.reshape(count, count)
    return np.asarray(down.T @ lattice @ across)


def edges_in_sigmas(pixels: int, places_px: FloatArray, sigma_px: float) -> FloatArray:
    """The edges of a row of pixels relative to places (n,), in sigmas: (n, pixels + 1)."""
    edges_px = np.arange(pixels + 1) - 0.5
    return np.asarray((edges_px - places_px[:, None]) / sigma_px)


def edges_px(image: FloatArray, radius_px: float, phase_deg: float) -> FloatArray:
    """Where the lit limb of a disc is in an image, px outward of its true place.

    The limb is where light falls to half of its value 3 px inside.
    """
    from scipy.ndimage import map_coordinates

    half = image.shape[0] // 2
    lit = 1.0 if phase_deg else np.pi  # radians to either side of the Sun's
    sun = np.cross(middle_direction(), BESIDE_AXIS)
    sun_rad = np.arctan2(sun[1], sun[0])
    angle = sun_rad + np.linspace(-lit, lit, PLACES)
    steps = np.linspace(-3.0, 3.0, 241)
    from_middle = radius_px + steps[None, :]
    cosine = np.cos(angle)[:, None]
    x_from_middle = from_middle * cosine
    x_px = half + MIDDLE_PX[0] + x_from_middle
    sine = np.sin(angle)[:, None]
    y_from_middle = from_middle * sine
    y_px = half + MIDDLE_PX[1] + y_from_middle
    profile = map_coordinates(image, [y_px, x_px], order=3, mode="nearest")
    return half_level_px(profile, steps)


def half_level_px(profile: FloatArray, steps: FloatArray) -> FloatArray:
    """Where light (n, m) falls to half of its first value, by steps (m,), px; NaN where it does
    not.
    """
    level = profile[:, :1] / 2
    below = profile < level
    first_below = np.argmax(below, axis=1)
    first = np.maximum(first_below, 1)
    rows = np.arange(len(profile))
    high = profile[rows, first - 1]
    low = profile[rows, first]
    fall = high - low
    above_level = high - level[:, 0]
    share = np.divide(above_level, fall, out=np.zeros_like(fall), where=fall > 0)
    step_px = steps[1] - steps[0]
    place = steps[first - 1] + step_px * share
    falls = below.any(axis=1)
    return np.asarray(np.where(falls, place, np.nan))


@dataclass(frozen=True, slots=True)
class Near:
    """A frame with a body near its middle: the fastest of some, ms.

    `over_white_mag` is how much brighter than white the brightest pixel is (negative: fainter).
    `finite` says that every pixel's light is a number, `white_is_white` that each pixel over white
    has white's code.
    """

    body: str
    off_deg: float
    frame_ms: float
    cpu_ms: float
    without_ms: float
    over_white_mag: float
    finite: bool
    white_is_white: bool
    stars: int


def approach(benches: Mapping[str, Bench], body: str, off_deg: float, rounds: int) -> Near:
    """Time a body at one angle from the boresight, and look at its light.

    `benches` holds "nothing" and the body's own.
    """
    bench = benches[body]
    start_ns = DAY_SIDE_NS if body == "Earth" else 0
    q = attitude(bench, body, off_deg, start_ns)
    empty = benches["nothing"]
    without, shown = fastest((empty, bench), q, start_ns, FRAME_NS, rounds)
    drawn = bench.draw(q, t_ns=start_ns)
    levels = drawn.levels.copy()
    light = bench.renderer.linear()
    found = against_white(
        light, levels, bench.flux_at_white_e_per_s, bench.calibration.response.white
    )
    return Near(
        body=body,
        off_deg=off_deg,
        frame_ms=shown.wall_ms,
        cpu_ms=shown.cpu_ms,
        without_ms=without.wall_ms,
        over_white_mag=found.over_white_mag,
        finite=found.finite,
        white_is_white=found.white_is_white,
        stars=drawn.star_count,
    )


@dataclass(frozen=True, slots=True)
class AgainstWhite:
    """A frame's light against white; see `Near`."""

    over_white_mag: float
    finite: bool
    white_is_white: bool


def against_white(
    light: Float32Array, levels: Levels, white: float, white_level: int
) -> AgainstWhite:
    """A frame's light (h, w) and its levels against the light and the level of white."""
    brightest = max(float(light.max()), 1e-9)
    over_white = levels[light > white]
    is_white = over_white == white_level
    return AgainstWhite(
        2.5 * math.log10(brightest / white), bool(np.isfinite(light).all()), bool(is_white.all())
    )


@dataclass(frozen=True, slots=True)
class BodiesMeasured:
    """The costs of scenes, the frames near bodies and the errors of discs, and the work of others
    while frames were timed.
    """

    costs: Sequence[BodyCost]
    nears: Sequence[Near]
    sizes: Sequence[Exactness]
    load: Load


def run(directory: Path, quick: bool = False) -> Judged:
    """Write `bodies_cost`, `bodies_size` and `bodies_limits` (PNG and CSV); a line for each
    finding. Raises InputError.
    """
    return report(directory, measure(quick))


def measure(quick: bool) -> BodiesMeasured:
    """Every scene's cost, every approach to a body, and every disc."""
    names: tuple[str, ...] = tuple(BODIES)
    rounds = ROUNDS
    near_deg = NEAR_DEG
    radii_px: tuple[float, ...] = RADII_PX
    if quick:
        names = QUICK_BENCHES
        rounds = QUICK_ROUNDS
        near_deg = QUICK_DEG
        radii_px = QUICK_RADII_PX
    near_rounds = max(QUICK_ROUNDS, rounds // 4)
    others = OtherWork()
    costs = []
    nears = []
    with opened(names) as benches:
        for scene in SCENES:
            if scene.bench in names:
                costs.append(measure_cost(benches, scene, rounds))
        for body, angles_deg in near_deg.items():
            for off_deg in angles_deg:
                nears.append(approach(benches, body, off_deg, near_rounds))
    load = others.load()
    sizes = []
    for phase, radius in product(PHASES_DEG, radii_px):
        sizes.append(exactness(radius, phase))
    return BodiesMeasured(costs, nears, sizes, load)


def report(directory: Path, measured: BodiesMeasured) -> Judged:
    """Write what was measured; a line for each finding. Raises InputError."""
    costs, nears, sizes, load = measured.costs, measured.nears, measured.sizes, measured.load
    write_rows(directory / "bodies_cost.csv", costs)
    write_rows(directory / "bodies_size.csv", sizes)
    write_rows(directory / "bodies_limits.csv", nears)
    draw_costs(directory / "bodies_cost", costs, load)
    draw_sizes(directory / "bodies_size", sizes)
    draw_limits(directory / "bodies_limits", nears, load)
    findings = [cost_line(costs), size_line(sizes), limits_line(nears)]
    return load.judged(findings)


def unseen_ms(costs: Sequence[BodyCost]) -> float:
    """The largest cost of bodies that are not drawn as discs, between steps of the orbit, ms."""
    largest_ms = 0.0
    for cost in costs:
        if not cost.discs and not at_a_step(cost.scene):
            largest_ms = max(largest_ms, cost.cpu_ms)
    return largest_ms


def cost_line(costs: Sequence[BodyCost]) -> str:
    """What bodies cost, in words."""
    dearest = max(costs, key=lambda cost: cost.cpu_ms)
    all_ms = max(costs[-1].cpu_ms, 0.0)
    return (
        f"bodies that are not in view, or points, take at most {unseen_ms(costs):.1f} ms of"
        f" processor time a frame, and all of them {all_ms:.1f} ms once in 2 s; the dearest:"
        f" {dearest.scene}, {dearest.cpu_ms:.0f} ms"
    )


def size_line(sizes: Sequence[Exactness]) -> str:
    """How exact discs are, in words."""
    limbs_px = [size.limb_off_px for size in sizes]
    limb_px = float(np.nanmax(limbs_px))
    largest_share = max(abs(size.flux_off) for size in sizes)
    flux_percent = 100 * largest_share
    largest_px = max(size.radius_px for size in sizes)
    return (
        f"discs of {sizes[0].radius_px:g} to {largest_px:g} px in radius have their light within"
        f" {flux_percent:.2g} % and their limb within {limb_px:.3f} px of rays in float64"
    )


def limits_line(nears: Sequence[Near]) -> str:
    """The slowest frame with a body in view, and what its light does, in words."""
    slowest = max(nears, key=lambda near: near.cpu_ms)
    place = f"{slowest.body} at {slowest.off_deg:g} degrees"
    return (
        f"a body in view takes at most {slowest.cpu_ms:.0f} ms of processor time a frame"
        f" ({place}); every pixel's light is {light_words(nears)}"
    )


def light_words(nears: Sequence[Near]) -> str:
    """Whether every pixel's light is finite and clips at white, in words."""
    if all(near.finite and near.white_is_white for near in nears):
        return "finite, and white where it is over white"
    return "NOT finite, or over white and not white"


def draw_costs(path: Path, costs: Sequence[BodyCost], load: Load) -> None:
    """What each scene costs."""
    dearest = max(costs, key=lambda cost: cost.cpu_ms)
    unseen = unseen_ms(costs)
    finding = (
        f"Between steps of an orbit bodies that are no discs cost at most {unseen:.1f}"
        f" ms; the dearest body, {dearest.scene}, {dearest.cpu_ms:.0f} ms"
    )
    title = load.title(finding, "Bodies of each kind on top of a frame")
    names = []
    times_ms = []
    for cost in costs:
        names.append(capital(cost.scene))
        positive_ms = max(cost.cpu_ms, 0.0)
        times_ms.append(round(positive_ms, 2))
    note = load.note(COST_NOTE)
    with chart(path, title, note=note, height_inch=4.4) as (axes,):
        value_bars(axes, names, times_ms, BLUE)
        axes.set_xlabel("processor time on top [ms]")


def size_line_of(error: str, style: str = "-", marker: str = "o", named: bool = True) -> LineSpec:
    """An error of discs against their radius."""
    return LineSpec("radius_px", at_least(error, FLOOR), style, marker, named, look=SMALL)


def draw_sizes(path: Path, sizes: Sequence[Exactness]) -> None:
    """The errors of discs against their radius."""
    flux_limit = LevelLine(FLUX_LIMIT, "limit")
    light = PanelSpec(
        (size_line_of("flux_off"),),
        "error [share]",
        title="Light of the whole disc",
        levels=(flux_limit,),
        **LOG_LOG,
    )
    limb = size_line_of("limb_off_px", marker="s", named=False)
    middle = size_line_of("middle_off_px", ":")
    limb_limit = LevelLine(LIMB_LIMIT_PX, "limit")
    place = PanelSpec(
        (limb, middle),
        "error [px]",
        title="Place of its limb (squares, solid) and of its middle (dotted)",
        levels=(limb_limit,),
        **LOG_LOG,
    )
    radii_px = sorted({size.radius_px for size in sizes})
    disc = size_line_of("pixel_off")
    point = size_line_of("point_pixel_off", ":", "x", False)
    point_limit = LevelLine(DISC_PX / 2, HIDDEN, MUTED)
    pixel = PanelSpec(
        (disc, point),
        "error [of the brightest]",
        "radius of the Moon's disc [px]",
        title="Its worst pixel, drawn as a disc (solid) and as a point (crosses, dotted)",
        places=(point_limit,),
        xticks=radii_px,
        **LOG_LOG,
    )
    phases = {phase_deg: f"{phase_deg:g} deg" for phase_deg in PHASES_DEG}
    looks = looks_of(phases)
    layout = {"height_inch": 8.4}
    panels = (light, place, pixel)
    spec = ChartSpec(panels, lambda size: size.phase_deg, looks, SIZE_NOTE, layout=layout)
    finding = size_line(sizes)
    draw_rows(path, finding, spec, sizes)


def draw_limits(path: Path, nears: Sequence[Near], load: Load) -> None:
    """Processor time and light as bodies come near."""
    light = f"Every pixel's light is {light_words(nears)}"
    finding = limits_line(nears)
    title = load.title(finding, light)
    bodies = dict.fromkeys(near.body for near in nears)
    looks = looks_of({body: body for body in bodies})
    spec = ChartSpec(LIMIT_PANELS, lambda near: near.body, looks, LIMIT_NOTE)
    draw_rows(path, title, spec, nears, load)
