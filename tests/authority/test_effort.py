"""The errors that `effort` and `quantisation` = "auto" claim, against codes of the real renderer
and a tracker of our own.

Nothing of the outside is hilstar's: a star is the exact integral of a Gaussian over pixels, codes
become light
by the formula of IEC 61966-2-1 or a power of 2.2, the tracker's optics and pixels are error
functions, and its
centroids are written here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from hilstar.optics.frame_motion import NODES_PER_SIGMA, POINT_SIGMA
from hilstar.optics.paths import node_counts, nodes_of
from hilstar.optics.sprites import pack_sprites
from hilstar.server.bench.build import load
from tests.support.benches import bench_text
from tests.support.claims import holds

SIZE_PX, STEP_PX, HALF_PX = (960, 540), 30, 12
FRAMES = 3  # of 540 stars each
FAINT_SHARE = 0.5  # of the stars looked at, which are the faintest tenth of those in the catalogue
MOMENTS = 24  # of a star's light along its path
# of a window that follows its star; the errors that are looked at are 1e-2 px
MAX_STEPS, SETTLED_PX = 60, 1e-6
# The claim is of the worst star, by the worst of six centroiders; of 1600 stars by four of them the
# worst has 0.5 to 0.96 of it. Where small sprites cut stars the claim is the sum of both parts'
# worst, at one star: 0.37 to 0.75 of it.
MOST, MOST_CUT = 2.1, 3.0
FRAME: dict[str, dict[str, object]] = {
    "tracker": {"resolution_px": [512, 512], "transmission": None},
    "monitor": {"resolution_px": list(SIZE_PX)},
    "collimator": {"focal_length_mm": 350},
}
# Bits, faintest V, tolerance (mag, px), calibration, effort, sigma of a sprite, pixel of the
# tracker (um; 11.5 are
# as wide as the monitor's)
BENCHES = [
    (8, 7.5, 0.05, 0.1, "srgb", "full", 0.85, 13),
    (8, 7.5, 0.3, 0.3, "srgb", "auto", 0.85, 13),
    (8, 6.0, 0.1, 0.1, "gamma2.2", "auto", 0.85, 13),
    (8, 5.0, 0.02, 0.02, "srgb", "auto", 0.7, 20),
    (10, 7.5, 0.1, 0.1, "srgb", "auto", 0.85, 13),
    (10, 7.5, 0.05, 0.1, "srgb", "auto", 0.85, 13),
    (10, 8.0, 0.02, 0.06, "gamma2.2", "full", 1.1, 8),
    (12, 7.5, 0.05, 0.05, "srgb", "auto", 0.85, 13),
    (12, 8.5, 0.02, 0.03, "srgb", "auto", 0.85, 23),
    (14, 7.5, 0.02, 0.02, "srgb", "auto", 0.6, 13),
    (16, 7.5, 0.02, 0.02, "srgb", "full", 0.85, 13),
]

SLOW_BITS = (12, 16)
SLOW_SHARE = 0.99  # of the motion from which on stars are paths
SLOW_FIELDS = 40  # 15 to 25 stars that stand alone in each
EDGE_PX = 20

# Stars of one to three codes, under Sirius as white, and stars that turn: bits, faintest V, V of
# white, codes, sigma of a sprite, turn (deg/s)
HARD = [
    (8, 7.5, -2.0, "exact", 0.55, 0.0),
    (8, 5.5, -2.0, "exact", 0.55, 1.0),
    (10, 5.5, -2.0, "round", 0.55, 1.0),
    (8, 7.5, 1.5, "exact", 0.85, 1.0),
    (10, 7.5, 1.5, "round", 0.85, 1.0),
    (12, 6.0, 1.5, "exact", 0.85, 1.0),
]


def norm_pdf(x):
    return np.exp(-(x**2) / 2) / math.sqrt(2 * math.pi)


def light_of_codes(codes, bits, calibration):
    signal = codes / (2.0**bits - 1)
    if calibration == "gamma2.2":
        return signal**2.2
    return np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4)


def true_stamps(x, y, sigma):
    """Each star's share of every pixel of its square (n, side, side), by error functions."""
    edges = np.arange(-HALF_PX, HALF_PX + 2) - 0.5
    across, down = (np.diff(ndtr((edges - place[:, None]) / sigma), axis=1) for place in (x, y))
    return down[:, :, None] * across[:, None, :]


@dataclass(frozen=True)
class TrackerViews:
    """The share of each lit square's columns, and rows, that pixels of a tracker collect
    (n, side, lit side), and where those pixels are, monitor pixels from the squares' middle.
    """

    columns: np.ndarray
    rows: np.ndarray
    places: tuple[np.ndarray, np.ndarray]

    def of(self, stamps):
        """What the pixels collect of lit squares (n, side, side)."""
        return self.rows @ stamps @ self.columns.transpose(0, 2, 1)


def tracker_views(phases, pixel_px, blur_px):
    """The views of stars at phases (2, n) of a tracker's pixels."""
    reach = math.ceil(HALF_PX / pixel_px)
    lit_edges = np.arange(-HALF_PX, HALF_PX + 2) - 0.5
    views, places = [], []
    for phase in phases:
        middles = (np.arange(-reach, reach + 1) + phase[:, None]) * pixel_px
        # a pixel ends where the next begins
        edges = (np.arange(-reach, reach + 2) - 0.5 + phase[:, None]) * pixel_px
        # a lit pixel's light up to an edge: the integral of the error function over its width
        beyond = (edges[:, :, None] - lit_edges) / blur_px
        integral = -blur_px * (beyond * ndtr(beyond) + norm_pdf(beyond))
        views.append(np.diff(np.diff(integral, axis=2), axis=1))
        places.append(middles)
    return TrackerViews(*views, tuple(places))


def centroids(stamps, views, sigma_px, boxes):
    """Centres of mass of all light, in 3 x 3 and 5 x 5 tracker pixels, and under a Gaussian that
    follows the star.
    """
    at = np.arange(-HALF_PX, HALF_PX + 1)
    light = stamps.sum(axis=(1, 2))
    found = {"moment": np.stack([stamps.sum(axis=1) @ at / light, stamps.sum(axis=2) @ at / light])}
    seen = views.of(stamps)
    x_at, y_at = views.places
    if boxes is None:
        boxes = np.divmod(seen.reshape(len(seen), -1).argmax(axis=1), seen.shape[2])
    row, column = boxes
    for half in (1, 2):
        y, x = (np.arange(seen.shape[1]) - middle[:, None] for middle in (row, column))
        found[f"box{2 * half + 1}"] = means(seen, np.abs(x) <= half, np.abs(y) <= half, x_at, y_at)
    place = found["box3"].copy()
    for _ in range(MAX_STEPS):
        x, y = (
            np.exp(-((where - p[:, None]) ** 2) / (2 * sigma_px**2))
            for where, p in zip((x_at, y_at), place, strict=True)
        )
        step = 1.5 * (means(seen, x, y, x_at, y_at) - place)
        place += step
        if np.abs(step).max() < SETTLED_PX:
            break
    found["window"] = place
    return found, boxes


def means(seen, x_weight, y_weight, x_at, y_at):
    """The mean x and y (2, n) of light, weighted along each axis (n, side)."""
    by_column = (y_weight[:, None, :] @ seen)[:, 0] * x_weight
    by_row = (seen @ x_weight[:, :, None])[:, :, 0] * y_weight
    total = by_column.sum(axis=1)
    return np.stack([(by_column * x_at).sum(axis=1), (by_row * y_at).sum(axis=1)]) / total


def swept_stamps(x, y, away, sigma):
    """The same of stars that move by `away` (2, n) px while their light lasts."""
    if not np.any(away):
        return true_stamps(x, y, sigma)
    moments = (np.arange(MOMENTS) + 0.5) / MOMENTS - 0.5
    return sum(true_stamps(x + away[0] * at, y + away[1] * at, sigma) for at in moments) / MOMENTS


def on_paths(x, y, away, sigma):
    """Where and how bright the sprites of each star's path are: its number, x, y, share."""
    lengths = np.hypot(*away) / sigma
    nodes = nodes_of(node_counts(lengths, NODES_PER_SIGMA, 1, POINT_SIGMA))
    along = nodes.place / 2
    stars = nodes.path
    return stars, x[stars] + away[0][stars] * along, y[stars] + away[1][stars] * along, nodes.share


def worst_errors(bench, calibration, sigma, rng, path_px=0.0):
    """The worst errors of lone stars that the real renderer draws: flux, mag, and place by each
    centroider, px. Each moves by `path_px` in a direction of its own.
    """
    bits, white = bench.config.monitor.bits, bench.flux_at_white_e_per_s
    rates = np.sort(bench.stars.electrons_per_s)
    rates = rates[rates * bench.psf.peak_share <= white]
    seen = bench.renderer.target.seen
    sigma_px = math.sqrt(sigma**2 + 1 / 6 + seen.blur_px**2)
    columns, rows = np.meshgrid(
        np.arange(20, SIZE_PX[0] - 20, STEP_PX), np.arange(20, SIZE_PX[1] - 20, STEP_PX)
    )
    columns, rows = columns.ravel(), rows.ravel()
    near = np.arange(-HALF_PX, HALF_PX + 1)
    flux_mag, off_px = 0.0, {}
    for _ in range(FRAMES):
        x, y = rng.uniform(-0.5, 0.5, (2, columns.size))
        some = rng.choice(rates, columns.size)
        faint = rng.random(columns.size) < FAINT_SHARE
        some[faint] = rng.choice(rates[: max(1, len(rates) // 10)], int(faint.sum()))
        way = rng.uniform(0.0, 2 * np.pi, columns.size)
        away = path_px * np.stack([np.cos(way), np.sin(way)])
        star, x_px, y_px, share = on_paths(columns + x, rows + y, away, sigma)
        sprites = pack_sprites(
            x_px, y_px, some[star] * share, star, SIZE_PX, bench.psf.footprint_px
        )
        sprites = replace(sprites, per_star=int(np.bincount(star).max()))
        bench.renderer.begin_anew()
        bench.renderer.draw(sprites, 0)
        codes = bench.code_values(bench.renderer.levels()).astype(np.float64)
        image = white * light_of_codes(codes, bits, calibration)
        shown = image[rows[:, None, None] + near[:, None], columns[:, None, None] + near]
        wanted = some[:, None, None] * swept_stamps(x, y, away, sigma)
        flux_mag = max(flux_mag, np.abs(2.5 * np.log10(shown.sum(axis=(1, 2)) / some)).max())
        phases = rng.uniform(-0.5, 0.5, (2, columns.size))
        views = tracker_views(phases, seen.pixel_px, seen.blur_px)
        there, boxes = centroids(wanted, views, sigma_px, None)
        here, _ = centroids(shown, views, sigma_px, boxes)
        for kind, place in here.items():
            off_px[kind] = max(off_px.get(kind, 0.0), np.hypot(*(place - there[kind])).max())
    return flux_mag, off_px


@pytest.mark.parametrize(
    ("bits", "faintest", "mag", "px", "calibration", "effort", "sigma", "pitch_um"), BENCHES
)
def test_the_claimed_error_is_the_worst_and_no_more(
    bits, faintest, mag, px, calibration, effort, sigma, pitch_um, tmp_path, rng
):
    path = tmp_path / "bench.toml"
    changed = {
        "tracker": {"pixel_pitch_um": pitch_um},
        "sky": {"faintest_v_mag": faintest},
        "monitor": {"bits": bits, "calibration": calibration},
        "render": {
            "tolerance_mag": mag,
            "tolerance_px": px,
            "effort": effort,
            "sprite_sigma_px": [sigma, sigma],
        },
    }
    path.write_text(bench_text(FRAME, changed))
    with load(path) as bench:
        claimed = bench.effort
        flux_mag, off_px = worst_errors(bench, calibration, sigma, rng)
        place_px = max(off_px.values())
        most = MOST if effort == "full" else MOST_CUT
        assert flux_mag <= claimed.error_mag <= most * flux_mag
        assert place_px <= claimed.error_px <= most * place_px


@pytest.mark.parametrize(("bits", "faintest", "white", "codes", "sigma", "turn_deg_s"), HARD)
def test_the_claim_holds_for_stars_of_few_codes_and_for_stars_that_turn(
    bits, faintest, white, codes, sigma, turn_deg_s, tmp_path, rng
):
    """Two of those that turn were over the claim in place, for it was of stars at rest; one was 2.5
    times over it in flux, for the shader left a path's wings dark and made up for nothing.
    """
    path = tmp_path / "bench.toml"
    changed = {
        "sky": {"faintest_v_mag": faintest},
        "monitor": {"bits": bits},
        "render": {
            "quantisation": codes,
            "motion": "on" if turn_deg_s else "off",
            "sprite_sigma_px": [sigma, sigma],
            "brightest_v_mag": white,
        },
    }
    path.write_text(bench_text(FRAME, changed))
    with load(path) as bench:
        claimed = bench.effort
        turned_rad = math.radians(turn_deg_s) * bench.scan.hold_s
        path_px = turned_rad * bench.camera.focal_length_px
        flux_mag, off_px = worst_errors(bench, "srgb", sigma, rng, path_px)
        place_px = max(off_px.values())
        assert flux_mag <= claimed.error_mag <= MOST * flux_mag
        # The claim is of slow turns, too, whose stars are drawn as points: the next test draws them.
        slow_px = claimed.taken.motion.choice.error_px
        assert place_px <= claimed.error_px <= MOST * max(place_px, slow_px)


def swept_places(bench, q_icrs_to_cam, rate_rad_s, stars):
    """Where stars are at the middle row's first light, px (2, n), and how fast they move there, px
    a second (2, n), through a pinhole.
    """
    icrs_to_cam = Rotation.from_quat(np.roll(q_icrs_to_cam, -1)).as_matrix()
    x, y, z = icrs_to_cam @ bench.stars.directions(stars).T
    moved = -np.cross(rate_rad_s, np.stack([x, y, z], axis=1)).T
    focal_px, middle_px = bench.camera.focal_length_px, (np.array(SIZE_PX) - 1) / 2
    slope = np.where(z > 0.5, np.stack([x, y]) / z, np.nan)
    return middle_px[:, None] + focal_px * slope, focal_px * (moved[:2] - slope * moved[2]) / z


def lone_stars(places_px):
    """The numbers of stars on the image that no other is near."""
    x, y = places_px
    beside = np.flatnonzero(
        (np.abs(x - SIZE_PX[0] / 2) < SIZE_PX[0]) & (np.abs(y - SIZE_PX[1] / 2) < SIZE_PX[1])
    )
    inside = beside[
        (x[beside] > EDGE_PX)
        & (x[beside] < SIZE_PX[0] - EDGE_PX)
        & (y[beside] > EDGE_PX)
        & (y[beside] < SIZE_PX[1] - EDGE_PX)
    ]
    apart_px = np.hypot(x[inside][:, None] - x[beside], y[inside][:, None] - y[beside])
    apart_px[inside[:, None] == beside] = np.inf
    return inside[apart_px.min(axis=1) > STEP_PX]


@pytest.mark.parametrize("bits", SLOW_BITS)
def test_the_claim_of_a_turn_too_slow_for_paths_is_what_its_frames_have(bits, tmp_path, rng):
    """Whole frames of such a turn against stars that move while their rows light one after the
    other. Drawn at the middle row's first light they were twice as far off.
    """
    path = tmp_path / "bench.toml"
    changed = {"monitor": {"bits": bits}, "render": {"motion": "on", "quantisation": "round"}}
    path.write_text(bench_text(FRAME, changed))
    sigma, off_px = 0.85, 0.0
    near = np.arange(-HALF_PX, HALF_PX + 1)
    with load(path) as bench:
        seen, scan, white = bench.renderer.target.seen, bench.scan, bench.flux_at_white_e_per_s
        sigma_px = math.sqrt(sigma**2 + 1 / 6 + seen.blur_px**2)
        slow_px = SLOW_SHARE * bench.config.render.motion_above_px
        slow_rad_s = slow_px / (max(bench.camera.scales_px_rad()) * scan.longest_s)
        rates = bench.stars.electrons_per_s
        shown_stars = np.flatnonzero(rates * bench.psf.peak_share <= white)
        for _ in range(SLOW_FIELDS):
            q_icrs_to_cam = Rotation.random(random_state=rng).as_quat(scalar_first=True)
            way = rng.uniform(0.0, 2 * np.pi)
            rate_rad_s = slow_rad_s * np.array([math.cos(way), math.sin(way), 0.0])
            every = np.arange(len(rates))
            places_px, speeds_px_s = swept_places(bench, q_icrs_to_cam, rate_rad_s, every)
            stars = np.intersect1d(lone_stars(places_px), shown_stars)
            if not len(stars):
                continue
            bench.renderer.begin_anew()
            drawn = bench.draw(q_icrs_to_cam, 0, rate_rad_s)
            codes = bench.code_values(drawn.levels).astype(np.float64)
            image = white * light_of_codes(codes, bits, "srgb")
            columns, rows = np.rint(places_px[:, stars]).astype(int)
            late_s = (places_px[1, stars] / SIZE_PX[1] - 0.5) * scan.scanout_s + scan.hold_s / 2
            x, y = places_px[:, stars] - (columns, rows) + speeds_px_s[:, stars] * late_s
            wanted = rates[stars, None, None] * swept_stamps(
                x, y, speeds_px_s[:, stars] * scan.hold_s, sigma
            )
            shown = image[rows[:, None, None] + near[:, None], columns[:, None, None] + near]
            phases = rng.uniform(-0.5, 0.5, (2, len(stars)))
            views = tracker_views(phases, seen.pixel_px, seen.blur_px)
            there, boxes = centroids(wanted, views, sigma_px, None)
            here, _ = centroids(shown, views, sigma_px, boxes)
            for kind, place in here.items():
                off_px = max(off_px, np.hypot(*(place - there[kind])).max())
        assert off_px <= bench.effort.error_px <= MOST * off_px


# Bits and codes of the table in docs/accuracy-speed.md, and its turns
TURNING = [(8, "exact"), (10, "round"), (16, "round")]
TURNS_DEG_S = (1, 5, 10)


def hold_turns(bench, bits, rng):
    """The worst light and place of stars in each turn; of windows, which find no place along a path
    of several pixels, apart.
    """
    path_px = math.radians(1.0) * bench.scan.hold_s * bench.camera.focal_length_px
    holds("turning-path", path_px)
    for turn_deg_s in TURNS_DEG_S:
        flux_mag, off_px = worst_errors(bench, "srgb", 0.85, rng, turn_deg_s * path_px)
        holds(f"turning-{bits}-{turn_deg_s}-mag", flux_mag)
        if turn_deg_s > 1:
            holds(f"turning-{bits}-{turn_deg_s}-windows", off_px.pop("window"))
        place_px = max(off_px.values())
        holds(f"turning-{bits}-{turn_deg_s}-px", place_px)
        if turn_deg_s == 1:
            assert flux_mag <= bench.effort.error_mag and place_px <= bench.effort.error_px


@pytest.mark.parametrize(("bits", "codes"), TURNING)
def test_the_table_of_turning_stars_has_what_they_have(bits, codes, tmp_path, rng):
    path = tmp_path / "bench.toml"
    changed = {"monitor": {"bits": bits}, "render": {"quantisation": codes, "motion": "on"}}
    path.write_text(bench_text(FRAME, changed))
    with load(path) as bench:
        holds(f"turning-{bits}-claimed-mag", bench.effort.error_mag)
        holds(f"turning-{bits}-claimed-px", bench.effort.error_px)
        hold_turns(bench, bits, rng)


def test_readme_s_bench_at_rest_is_within_what_is_claimed(tmp_path, rng):
    path = tmp_path / "bench.toml"
    path.write_text(bench_text(FRAME, {"render": {"quantisation": "exact", "motion": "off"}}))
    with load(path) as bench:
        flux_mag, off_px = worst_errors(bench, "srgb", 0.85, rng)
        claimed = bench.effort
        assert flux_mag <= claimed.error_mag <= MOST * flux_mag
        assert max(off_px.values()) <= claimed.error_px <= MOST * max(off_px.values())
        holds("rest-8-claimed-mag", claimed.error_mag)
        holds("rest-8-claimed-px", claimed.error_px)
        holds("slow-turn-px", bench.config.render.motion_above_px / 3)
