"""Faults in the virtual tracker: the light of its exposures, and that it is the display's."""

from __future__ import annotations

import io
from collections import deque
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from PIL import Image

import hilstar
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.rotation import angle_between_rad, from_radec_roll_deg
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from hilstar.instruments.simulate import batch
from hilstar.instruments.simulate.exposures import LogFaults, faulty_exposure
from hilstar.instruments.simulate.pictures import TrackerPictures
from hilstar.instruments.simulate.simulator import (
    FrameNoise,
    Simulator,
    _merge,
    exposure_truth,
    joined,
    pieces_of,
)
from hilstar.optics.layers.fault_kinds import KINDS, Now
from hilstar.optics.layers.layers import light_of, sky_layers
from hilstar.optics.layers.truth import TRUTH_DTYPE
from hilstar.optics.layers.view import STILL, View
from hilstar.optics.sprites import join_sprites
from hilstar.server.bench.bench_file import bench_file_of, read_bench_file
from hilstar.server.bench.cameras import bench_camera, tracker_camera
from hilstar.server.bench.fault_views import faults_at
from hilstar.server.bench.scenario import Timetable, parse_scenario
from tests.support.benches import ORION_Q, SMALL_BENCH, bench_text

EXPOSURE_S = 0.1  # the bench's default
LIGHT_SHARE = 2e-6  # float32, and a footprint's cut
# of the display's places on the detector: float32 fractions, and the slower star of a frame's
# middle
PLACE_PX = 2e-3

HEAD = "seed = 5\n"
GHOST = """
[[fault]]
kind = "false-star"
name = "ghost"
at_s = 1.0
for_s = 1.0
tracker_px = [480, 530]
electrons = 4e4
"""


@pytest.fixture(scope="module")
def simulator(tmp_path_factory):
    folder = tmp_path_factory.mktemp("faults")
    text = SMALL_BENCH + "[background]\nelectrons_per_px = 0.5\n"
    with Simulator(bench_file_of(folder / "bench.toml", text)) as opened:
        yield opened


def test_a_star_is_clipped_by_its_own_pixel_wherever_it_is_on_the_detector(simulator):
    """A pixel beside its own is another star's; a mosaic's is not. On a detector that is no square
    stars beyond its sides are on none of its pixels.
    """
    view = simulator.view(np.array(ORION_Q), np.zeros(3))
    layers = sky_layers(simulator.canvas, simulator.sources)
    light = light_of(simulator.canvas, layers, simulator.stars, view)
    seen = simulator.canvas, view, simulator.stars, light
    dark = exposure_truth(*seen, np.zeros((1024, 1024)))
    column, row = (np.rint(dark[name]).astype(int) for name in ("x_px", "y_px"))
    for height, width in ((1024, 700), (700, 1024)):
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        full, others = np.flatnonzero(inside)[::2], np.flatnonzero(inside)[1::2]
        mean_e = np.zeros((height, width))
        mean_e[row[others], np.minimum(column[others] + 1, width - 1)] = 1e9
        mean_e[row[others], column[others]] = simulator.canvas.full_e
        mean_e[row[full], column[full]] = simulator.canvas.full_e + 1
        truth = exposure_truth(*seen, mean_e)
        is_full = np.zeros(len(dark), dtype=bool)
        is_full[inside] = mean_e[row[inside], column[inside]] > simulator.canvas.full_e
        assert is_full[full].all() and not is_full[others].all()
        assert truth["clipped"].tolist() == is_full.tolist()


def exposed(simulator, text, at_s, rate=(0.0, 0.0, 0.0)):
    scenario = parse_scenario(simulator.file.path.with_name("faults.toml"), HEAD + text)
    view = simulator.view(np.array(ORION_Q), np.array(rate))
    faults = faulty_exposure(simulator, [view], scenario, round(at_s * NS_PER_S))
    return simulator.expose(view, None, faults=faults), faults


def light_e(exposure):
    return exposure.mean_e.sum()


def test_a_fault_that_is_not_on_leaves_the_exposure_as_it_is(simulator):
    plain = simulator.expose(simulator.view(np.array(ORION_Q), np.zeros(3)), None)
    off, _ = exposed(simulator, GHOST, 5.0)
    assert np.array_equal(off.mean_e, plain.mean_e) and off.faults == ()


@pytest.mark.parametrize(("at_s", "share"), [(1.5, 1.0), (1.0, 0.5), (0.97, 0.2), (2.04, 0.1)])
def test_an_exposure_has_a_fault_s_light_for_the_part_that_it_lasts(simulator, at_s, share):
    plain = simulator.expose(simulator.view(np.array(ORION_Q), np.zeros(3)), None)
    seen, _ = exposed(simulator, GHOST, at_s)
    assert light_e(seen) - light_e(plain) == pytest.approx(share * 4e4, rel=1e-3)
    row = seen.truth[seen.truth["name"] == "ghost"][0]
    assert row["electrons_per_s"] == pytest.approx(share * 4e4 / EXPOSURE_S, rel=1e-6)
    assert (row["x_px"], row["y_px"]) == (
        pytest.approx(480, abs=1e-3),
        pytest.approx(530, abs=1e-3),
    )


def test_a_fault_s_light_leaves_the_first_star_of_the_catalogue_its_own(simulator):
    (x, y, z), *_ = simulator.stars.vectors
    ra_deg, dec_deg = np.degrees([np.arctan2(y, x), np.arcsin(z)]).tolist()
    view = simulator.view(from_radec_roll_deg(ra_deg, dec_deg, 0.0), np.zeros(3))
    plain = simulator.expose(view, None)
    scenario = parse_scenario(simulator.file.path.with_name("faults.toml"), HEAD + GHOST)
    faults = faulty_exposure(simulator, [view], scenario, round(1.5 * NS_PER_S))
    seen = simulator.expose(view, None, faults=faults)
    assert simulator.stars.hip[0] in plain.truth["hip"]
    assert seen.truth["hip"].tolist() == [*plain.truth["hip"].tolist(), 0]


def test_a_moving_false_star_leaves_a_streak_of_its_light(simulator):
    plain = simulator.expose(simulator.view(np.array(ORION_Q), np.zeros(3)), None)
    seen, _ = exposed(
        simulator, GHOST.replace("[480, 530]", "[480, 530]\nrate_px_s = [300, 0]"), 1.5
    )
    added = seen.mean_e - plain.mean_e
    assert added.sum() == pytest.approx(4e4, rel=1e-3)
    # From 1.45 to 1.55 s: 480 + 300 (0.45 to 0.55) is 615 to 645
    columns = np.average(np.arange(1024), weights=added.sum(axis=0))
    assert columns == pytest.approx(630, abs=0.05)
    width = np.sqrt(np.average((np.arange(1024) - columns) ** 2, weights=added.sum(axis=0)))
    assert width == pytest.approx(
        np.hypot(30 / np.sqrt(12), np.hypot(0.55, np.sqrt(1 / 12))), abs=0.1
    )


def test_blank_freeze_and_step(simulator):
    # covered in the last fifth, in which stars and background are not seen
    dark, _ = exposed(simulator, '[[fault]]\nkind = "blank"\nname = "cover"\nat_s = 1.0', 0.96)
    plain = simulator.expose(simulator.view(np.array(ORION_Q), np.zeros(3)), None)
    assert light_e(dark) == pytest.approx(light_e(plain) * 0.9, rel=LIGHT_SHARE)
    turning = (0.0, 0.02, 0.0)
    _, stuck = exposed(
        simulator, '[[fault]]\nkind = "freeze"\nname = "stuck"\nat_s = 0.9\nfor_s = 1', 1.0, turning
    )
    (piece,) = stuck.pieces
    assert not piece.view.rate_cam_rad_s.any()
    turned_rad = angle_between_rad(piece.view.q_icrs_to_cam, np.array(ORION_Q))
    assert turned_rad == pytest.approx(0.02 * 0.1, rel=1e-6)  # as at 0.9 s
    moved, _ = exposed(
        simulator,
        '[[fault]]\nkind = "attitude-step"\nname = "s"\nat_s = 0\nturn_arcsec = [0, 600, 0]',
        1.0,
    )
    star = plain.truth[plain.truth["hip"] == 26727][0]
    whole = moved.mean_e[: int(star["y_px"]) + 6, : int(star["x_px"]) + 40]
    y, x = np.unravel_index(np.argmax(whole), whole.shape)
    shift_px = 600 / ARCSEC_PER_RAD * 70 / 0.013
    assert abs(x - star["x_px"]) == pytest.approx(shift_px, abs=1.0) and abs(y - star["y_px"]) < 1.0


ALIKE = (
    HEAD
    + GHOST
    + """
[[fault]]
kind = "cosmic-rays"
name = "rays"
at_s = 1.0
for_s = 0.5
number = 6
electrons = 3e4
length_px = 12
[[fault]]
kind = "flash"
name = "flare"
at_s = 1.0
for_s = 0.5
hip = 26727
v_mag = 1.0
"""
)


def test_display_and_tracker_have_the_same_light_at_the_same_places(simulator, tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(SMALL_BENCH)
    scenario = parse_scenario(tmp_path / "faults.toml", ALIKE)
    with hilstar.load(path) as bench:
        shown = bench.frame(
            ORION_Q, faults=faults_at(bench, scenario, round(1.25 * NS_PER_S))
        ).truth
    view = simulator.view(np.array(ORION_Q), np.zeros(3))
    seen = simulator.expose(
        view, None, faults=faulty_exposure(simulator, [view], scenario, round(1.25 * NS_PER_S))
    ).truth
    config = simulator.config
    monitor, tracker = bench_camera(config, tmp_path), tracker_camera(config.tracker, tmp_path)
    ours = shown[np.isin(shown["name"], ["ghost", "rays", "flare"])]
    x_px, y_px = tracker.project(monitor.rays(ours["x_px"], ours["y_px"]) @ tracker.cam_to_image.T)
    theirs = seen[np.isin(seen["name"], ["ghost", "rays", "flare"])]
    assert len(theirs) > 2
    matched = 0
    for x, y, row in zip(x_px, y_px, ours, strict=True):
        off = np.hypot(theirs["x_px"] - x, theirs["y_px"] - y)
        if 8 < x < 1015 and 8 < y < 1015:
            nearest = theirs[np.argmin(off)]
            matched += 1
            assert off.min() < PLACE_PX and nearest["name"] == row["name"]
            assert (
                nearest["electrons_per_s"] == pytest.approx(row["electrons_per_s"], rel=1e-5)
                or row["name"] == "rays"
            )
    assert matched > 2


def test_a_simulation_s_pictures_have_the_faults_of_the_display(tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(SMALL_BENCH)
    scenario = parse_scenario(
        tmp_path / "faults.toml", GHOST + '[[fault]]\nkind = "freeze"\nname = "stuck"'
    )
    ghost, stuck = (Now(k, fault, 0) for k, fault in enumerate(scenario.faults, start=1))
    on = []
    with hilstar.load(path) as bench:
        pictures = TrackerPictures(bench, scenario, lambda: tuple(on))
        here = AttitudeSample(0, np.array(ORION_Q))
        away = AttitudeSample(0, np.array([0.7071068, 0.7071068, 0.0, 0.0]))
        plain = dn_of(pictures(here))
        on.append(ghost)
        seen = dn_of(pictures(here))
        on[:] = [stuck]
        stands = dn_of(pictures(away))
    spot = slice(528, 533), slice(478, 483)
    assert seen[spot].sum() > plain[spot].sum() + 0.5 * 4e4 / 24  # e-/DN of the default detector
    # the same stars, with other noise
    assert np.abs(stands.astype(float) - plain).max() < 0.2 * plain.max()


def dn_of(png):
    return np.asarray(Image.open(io.BytesIO(png)), dtype=np.uint16) >> 4


def test_an_exposure_has_the_discs_and_the_capped_stars_of_all_its_pieces():
    nothing = join_sprites([], 5)
    seen = ((2, ("Moon",)), (0, ()), (3, ("Sun", "Moon")))
    whole = joined([replace(nothing, capped=capped, discs=discs) for capped, discs in seen])
    assert (whole.capped, whole.discs, whole.footprint_px) == (5, ("Moon", "Sun"), 5)


def test_light_of_one_point_in_two_pieces_is_in_the_middle_of_it():
    rows = np.zeros(2, dtype=TRUTH_DTYPE)
    rows["x_px"], rows["y_px"] = [10.0, 14.0], [8.0, 4.0]
    rows["electrons_per_s"] = [30.0, 10.0]
    _merge(rows[0], rows[1])
    assert (rows["x_px"][0], rows["y_px"][0]) == pytest.approx((11.0, 7.0))
    assert rows["electrons_per_s"][0] == 40.0


def test_each_piece_of_an_exposure_has_its_own_middle_on_the_clock_of_its_view(tmp_path):
    """0.1 s about the 2nd second of a scenario, in which a fault is on from 1.97 to 1.99 s."""
    text = '[[fault]]\nkind = "blank"\nname = "cover"\nat_s = 1.97\nfor_s = 0.02\n'
    scenario = parse_scenario(tmp_path / "faults.toml", text)
    timetable = Timetable(scenario, lambda fault: fault, 0.1)
    start_ns = 10**15
    view = View.exposure(np.array([1.0, 0.0, 0.0, 0.0]), STILL, 0.1, start_ns)
    pieces = pieces_of(view, 2 * NS_PER_S, timetable)
    assert [len(piece.now) for piece in pieces] == [0, 1, 0]
    middles_ms = [(piece.view.t_ns - start_ns) / 1e6 for piece in pieces]
    assert middles_ms == [-40.0, -20.0, 20.0]
    assert [piece.view.exposure_s for piece in pieces] == pytest.approx([0.02, 0.02, 0.06])


def test_an_exposure_of_several_views_has_them_one_after_the_other_about_its_middle(tmp_path):
    """0.06 s and 0.04 s about the 2nd second: from 1.95 to 2.01 and to 2.05 s."""
    text = '[[fault]]\nkind = "blank"\nname = "cover"\nat_s = 2.02\nfor_s = 0.01\n'
    scenario = parse_scenario(tmp_path / "faults.toml", text)
    views = [View.exposure(np.array(ORION_Q), STILL, length_s) for length_s in (0.06, 0.04)]
    file = bench_file_of(tmp_path / "bench.toml", bench_text())
    with Simulator(file) as simulator:
        pieces = faulty_exposure(simulator, views, scenario, 2 * NS_PER_S).pieces
    assert [len(piece.now) for piece in pieces] == [0, 0, 1, 0]
    lengths_s = [piece.view.exposure_s for piece in pieces]
    assert lengths_s == pytest.approx([0.06, 0.01, 0.01, 0.02])


def test_faults_of_a_log_count_from_its_first_sample(tmp_path):
    """Of a clock that is far from 0: the display stands still from the first second on, in which it
    has the log's own attitude.
    """
    start_ns = 10**15
    turned = np.array([np.cos(0.1), 0.0, np.sin(0.1), 0.0])
    samples = [
        AttitudeSample(start_ns, np.array([1.0, 0.0, 0.0, 0.0])),
        AttitudeSample(start_ns + 2 * NS_PER_S, turned),
    ]
    text = '[[fault]]\nkind = "freeze"\nname = "stuck"\nat_s = 1.0\n'
    scenario = parse_scenario(tmp_path / "faults.toml", text)
    tracker = {"resolution_px": [64, 48], "exposure_s": 0.1}
    file = bench_file_of(tmp_path / "bench.toml", bench_text({"tracker": tracker}))
    views = [View.exposure(turned, STILL, 0.1, start_ns + at) for at in (0, 2 * NS_PER_S)]
    with Simulator(file) as simulator:
        moving, standing = LogFaults(scenario, samples).pieces(simulator, views)
    assert [len(piece.now) for piece in (*moving, *standing)] == [0, 1]
    half = np.array([np.cos(0.05), 0.0, np.sin(0.05), 0.0])
    assert moving[0].view.q_icrs_to_cam == pytest.approx(turned)
    assert angle_between_rad(standing[0].view.q_icrs_to_cam, half) < 1e-9


def test_pictures_of_a_run_have_a_noise_each_and_stand_where_the_display_does(tmp_path):
    """As a simulator has them that is given the noise and the view of each."""
    tracker = {"resolution_px": [120, 90], "exposure_s": EXPOSURE_S}
    path = tmp_path / "bench.toml"
    sky = {"faintest_v_mag": 4.0}
    path.write_text(
        bench_text({"tracker": tracker, "sky": sky, "render": {"quantisation": "round"}})
    )
    frozen = Now(1, KINDS["freeze"](name="stuck"), 0)
    on = []
    rate = np.array([0.0, 0.02, 0.0])
    first = AttitudeSample(5, np.array(ORION_Q), rate)
    away = AttitudeSample(9, np.array([0.6, 0.8, 0.0, 0.0]), rate)
    taken = []
    with hilstar.load(path) as bench:
        pictures = TrackerPictures(bench, now=lambda: tuple(on))
        for sample, faults in ((first, []), (away, [frozen]), (away, [frozen]), (away, [])):
            on[:] = faults
            taken.append(dn_of(pictures(sample)))
    with Simulator(read_bench_file(path)) as simulator:
        moving, still, elsewhere = (
            simulator.view(q, turn)
            for q, turn in ((ORION_Q, rate), (ORION_Q, STILL), (away.q_icrs_to_cam, rate))
        )
        for number, view in enumerate((moving, still, still, elsewhere)):
            rng = np.random.default_rng((0, number))
            np.testing.assert_array_equal(taken[number], simulator.expose(view, rng).dn)


def test_a_worker_writes_exposures_each_with_its_number_s_noise_and_how_it_was_made(tmp_path):
    """The same light as of a simulator that is asked here, with the noise of (seed, number)."""
    rate_deg_s = np.array([0.1, -0.2, 0.4])
    tracker = {"resolution_px": [120, 90], "exposure_s": EXPOSURE_S}
    text = bench_text({"tracker": tracker, "sky": {"faintest_v_mag": 4.0}})
    file = bench_file_of(tmp_path / "bench.toml", text)
    detector = file.config.tracker.detector
    ghost = HEAD + GHOST.replace("480, 530", "70, 20")
    scenario = parse_scenario(tmp_path / "faults.toml", ghost)
    noise = FrameNoise("full", 8)
    with Simulator(file) as simulator:
        view = simulator.view(np.array(ORION_Q), np.radians(rate_deg_s))
        ghostly = faulty_exposure(simulator, [view], scenario, round(1.5 * NS_PER_S))
        plain = simulator.expose(view, np.random.default_rng((8, 27)))
        faulty = simulator.expose(view, np.random.default_rng((8, 27)), faults=ghostly)
    for planned, pieces, wanted, names in (
        (None, (), plain, None),
        (scenario, ghostly.pieces, faulty, "ghost"),
    ):
        nothing, expose = batch._start_exposing(file, noise, tmp_path, planned)
        assert nothing is None
        expose(27, view, pieces)
        with fits.open(tmp_path / "exposure_000027.fits") as (image, table):
            np.testing.assert_array_equal(image.data, wanted.dn)
            assert table.data["x_px"].tolist() == wanted.truth["x_px"].tolist()
            header = image.header
        rates = [header[name] for name in ("RATEX", "RATEY", "RATEZ")]
        assert rates == pytest.approx(rate_deg_s)
        assert (header["NOISE"], header["SEED"], header["EXPTIME"]) == ("full", 8, EXPOSURE_S)
        device = (detector.gain_e_per_dn, detector.offset_dn, detector.full_well_e, detector.bits)
        assert tuple(header[name] for name in ("GAIN", "OFFSET", "FULLWELL", "BITS")) == device
        assert header["DEVSEED"] == detector.device_seed
        assert header.get("FAULTS") == names
        assert header["NSTARS"] == len(wanted.truth)


class PoolHere:
    """A pool of workers in this process: each works at once, and answers when it is asked."""

    opened: list[PoolHere]

    def __init__(self, start, arguments, errors) -> None:
        self.start_work, self.arguments = start, arguments
        self.workers: list[PoolHere] = []
        self.news: deque[tuple[PoolHere, str, object]] = deque()
        self.opened.append(self)

    def __enter__(self) -> PoolHere:
        return self

    def __exit__(self, *error: object) -> None:
        """Nothing is left behind."""

    def start(self) -> None:
        greeting, self.work = self.start_work(*self.arguments)
        self.workers.append(self)
        self.news.append((self, "ready", greeting))

    def heard(self):
        yield self.news.popleft()

    def give(self, task, *arguments) -> None:
        self.news.append((self, "answer", self.work(*arguments)))


def test_every_view_of_a_log_is_exposed_once_with_its_own_number_and_faults(tmp_path, monkeypatch):
    """Three views, of which the second has the ghost: two cores take them in turn."""
    PoolHere.opened = []
    monkeypatch.setattr(batch, "ProcessPool", PoolHere)
    monkeypatch.setattr(batch.os, "sched_getaffinity", lambda process: {0, 1})
    tracker = {"resolution_px": [120, 90], "exposure_s": EXPOSURE_S}
    text = bench_text({"tracker": tracker, "sky": {"faintest_v_mag": 3.0}})
    file = bench_file_of(tmp_path / "bench.toml", text)
    scenario = parse_scenario(tmp_path / "faults.toml", HEAD + GHOST.replace("480, 530", "70, 20"))
    zero_ns = 10**18
    samples = []
    for at_s in (0.0, 1.5, 4.0):
        samples.append(AttitudeSample(zero_ns + round(at_s * NS_PER_S), np.array(ORION_Q)))
    noise = FrameNoise("full", 8)
    with Simulator(file) as simulator:
        views = []
        for turn_deg, sample in zip((0, 20, 40), samples, strict=True):
            rate = np.radians([0.0, 0.0, turn_deg])
            views.append(simulator.view(np.array(ORION_Q), rate, sample.t_ns))
        done: list[int] = []
        batch.simulate_views(
            file, views, noise, tmp_path / "out", done.append, LogFaults(scenario, samples)
        )
        assert done == [1, 2, 3]
        (pool,) = PoolHere.opened
        assert len(pool.workers) == 2
        assert len(list((tmp_path / "out").iterdir())) == 3
        for number, view in enumerate(views):
            with fits.open(tmp_path / "out" / f"exposure_{number:06d}.fits") as (image, _):
                header, dn = image.header, image.data.copy()
            assert header.get("FAULTS") == ("ghost" if number == 1 else None)
            assert header["RATEZ"] == pytest.approx((0, 20, 40)[number])
            if number != 1:
                plain = simulator.expose(view, np.random.default_rng((8, number)))
                np.testing.assert_array_equal(dn, plain.dn)
