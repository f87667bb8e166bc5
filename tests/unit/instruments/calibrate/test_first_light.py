"""The parts of first light: which way round, how sharp, what a step depends on, and images by a
command.
"""

from __future__ import annotations

import math
import shlex
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from msgspec import structs
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

from hilstar.basics.errors import InputError
from hilstar.display.geometry import monitor_camera
from hilstar.display.window import window as windows
from hilstar.instruments.calibrate.first_light.context import KeyChange, StepOutcome, rewrite
from hilstar.instruments.calibrate.first_light.focus import sharpness
from hilstar.instruments.calibrate.first_light.geometry import (
    UPRIGHT,
    WAYS,
    ScreenMounting,
    SquaresAlike,
    _is_oblique,
    corrected,
    draw_spots,
    figure_for,
    keys_of_ways,
    look_of,
    see_figure,
)
from hilstar.instruments.calibrate.first_light.image_sources import (
    GrabCommand,
    ImageSource,
    NoImage,
    Pattern,
    PatternDisplay,
    black,
    off_screen,
    on_screen,
)
from hilstar.instruments.calibrate.first_light.session import (
    FirstLightSession,
    SessionPlan,
)
from hilstar.instruments.calibrate.first_light.steps import SessionStep
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.optics.scan import Orientation
from hilstar.server.bench.bench_file import read_bench_file
from tests.support.bench_files import filed_bench
from tests.support.benches import bench_text
from tests.support.claims import holds
from tests.support.damage import NO_JSON
from tests.support.refusals import refusal

NO_TURN = np.array([1.0, 0.0, 0.0, 0.0])
MOUNTINGS = [
    ScreenMounting(x, y, turn)
    for x in (False, True)
    for y in (False, True)
    for turn in (0, 90, 180, 270)
]
GEOMETRY = BenchGeometry(
    monitor_camera((640, 480), 57.65, 120, NO_TURN), monitor_camera((400, 400), 13, 25, NO_TURN)
)


def orientation_of(mounting):
    return Orientation(mounting.flip_x, mounting.flip_y, mounting.rotate_deg // 90)


@pytest.mark.parametrize("mounting", MOUNTINGS, ids=str)
def test_what_is_turned_onto_the_screen_comes_off_it_as_it_was(mounting):
    image = np.arange(6, dtype=np.uint16).reshape(2, 3)
    screen = on_screen(image, orientation_of(mounting))
    assert screen.shape[::-1] == orientation_of(mounting).screen_px((3, 2))
    assert (off_screen(screen, orientation_of(mounting)) == image).all()


@pytest.mark.parametrize("mounting", MOUNTINGS, ids=str)
def test_a_mounting_moves_a_pixel_as_its_matrix_says(mounting):
    image = np.zeros((5, 5), dtype=np.uint16)
    image[2, 4] = 1  # two to the right of the middle
    ((row, column),) = np.argwhere(on_screen(image, orientation_of(mounting)))
    assert (column - 2, row - 2) == tuple(2 * mounting.matrix[:, 0])


def spots(figure, way):
    """The figure as a tracker sees it `way` round: squares of light about the middle of its
    image.
    """
    image = np.random.default_rng(1).normal(0, 1.0, (400, 400))
    ratio = GEOMETRY.tracker.focal_length_px / GEOMETRY.monitor.focal_length_px
    for x, y, sides in zip(figure.x_px, figure.y_px, (3, 2, 1), strict=True):
        right, down = np.array(way).reshape(2, 2) @ [x - 319.5, y - 239.5]
        left, top = (round(199.5 + ratio * part - 1.4 * sides) for part in (right, down))
        image[top : top + round(2.8 * sides), left : left + round(2.8 * sides)] += 500
    return image


@pytest.mark.parametrize("way", WAYS, ids=WAYS.get)
def test_the_figure_tells_each_way_round_and_the_mounting_that_mends_it(way):
    figure = figure_for(GEOMETRY)
    seen = see_figure(spots(figure, way), figure, GEOMETRY)
    assert seen.way == way
    assert seen.scale == pytest.approx(1.0, abs=0.02)
    for mounting in MOUNTINGS:
        # What the tracker sees is the optics' own matrix times the mounting's; the corrected one
        # leaves the identity.
        optics = np.array(way).reshape(2, 2) @ np.linalg.inv(mounting.matrix)
        assert np.allclose(optics @ corrected(mounting, way).matrix, np.eye(2))


# two of the monitor's pixels to one of the tracker's
COARSE = BenchGeometry(
    GEOMETRY.monitor,
    monitor_camera((400, 300), 13, 13 * GEOMETRY.monitor.focal_length_px / 2000, NO_TURN),
)


def figure_image(figure, seen_as: np.ndarray, lights=(9.0, 4.0, 1.0)) -> np.ndarray:
    """The figure's squares as Gaussians of a sigma of 2 px in COARSE's tracker, their places about
    its middle multiplied by a matrix.
    """
    image = np.random.default_rng(4).normal(0, 1.0, (300, 400))
    y, x = np.mgrid[:300, :400]
    for *place, light in zip(figure.x_px, figure.y_px, lights, strict=True):
        right, down = seen_as @ (np.array(place) - [319.5, 239.5]) / 2
        far2 = (x - 199.5 - right) ** 2 + (y - 149.5 - down) ** 2
        image += 1000 * light * np.exp(-far2 / 8)
    return image


def test_a_figure_tells_focal_length_and_turn_and_how_sure_that_is():
    figure = figure_for(COARSE)
    cos, sin = math.cos(math.radians(-20)), math.sin(math.radians(-20))
    larger = 1.1 * np.array([[cos, -sin], [sin, cos]])
    seen = see_figure(figure_image(figure, larger), figure, COARSE)
    assert seen.scale == pytest.approx(1.1, rel=1e-3)
    assert seen.focal_length_px == pytest.approx(COARSE.monitor.focal_length_px / 1.1, rel=1e-3)
    assert seen.turn_deg == pytest.approx(-20.0, abs=0.05)
    # a tenth of a pixel over the figure's side, 2 * 120 px of the monitor and 120 of the tracker's
    assert figure.reach_px == 120
    assert seen.turn_error_deg == pytest.approx(math.degrees(0.1 / 120), rel=0.1)


@pytest.mark.parametrize("size_px", [(400, 100), (100, 400)])
def test_a_figure_is_half_as_large_as_the_smallest_side_of_screen_and_field(size_px):
    """100 px of the tracker are 200 of the monitor: a figure of 100, a quarter to each side."""
    middle_px = tuple((side - 1) / 2 for side in size_px)
    tracker = replace(COARSE.tracker, resolution_px=size_px, principal_point_px=middle_px)
    figure = figure_for(BenchGeometry(COARSE.monitor, tracker))
    assert figure.reach_px == 50
    # of squares of whole pixels
    sides_px = np.abs(np.diag(figure.axes_px))
    assert sides_px == pytest.approx([100, 100], abs=1)


@pytest.mark.parametrize(("side_px", "has_space"), [(30, True), (29, False)])
def test_a_figure_needs_space_for_its_largest_square(side_px, has_space):
    """Of 3 x 5 px of the monitor, as far from the middle as a quarter of what the tracker sees."""
    middle_px = ((side_px - 1) / 2,) * 2
    tracker = replace(
        COARSE.tracker, resolution_px=(side_px, side_px), principal_point_px=middle_px
    )
    geometry = BenchGeometry(COARSE.monitor, tracker)
    if has_space:
        assert figure_for(geometry).side_px == 5
        return
    assert refusal(figure_for, geometry).startswith("the tracker sees too little of the monitor")


def test_spots_are_drawn_where_the_tracker_sees_them_each_with_its_name_inwards(tmp_path, figures):
    """In an image of twice as many columns as are drawn, whose brightest pixels stay."""
    image = np.zeros((20, 1462))
    image[3, 1001] = image[7, 600] = image[16, 20] = 900.0
    x_px, y_px = np.array([1001.0, 600.0, 20.0]), np.array([3.0, 7.0, 16.0])
    draw_spots(tmp_path / "spots", image, x_px, y_px, "a finding")
    (axes,) = figures[0].axes
    (drawn,) = axes.images
    assert drawn.get_extent() == [-0.5, 1461.5, 19.5, -0.5]
    grey = drawn.get_array()
    assert grey.shape == (10, 731)
    assert [grey[1, 500], grey[3, 300], grey[8, 10]] == [30.0] * 3
    np.testing.assert_array_equal(axes.collections[0].get_offsets(), np.stack([x_px, y_px], axis=1))
    names = [(text.get_text(), text.xy, text.get_ha()) for text in axes.texts]
    assert names == [
        ("corner", (1001.0, 3.0), "right"),
        ("right", (600.0, 7.0), "left"),
        ("below", (20.0, 16.0), "left"),
    ]


@pytest.mark.parametrize("seen_as", [np.diag([1.4, 1.0]), np.diag([1.0, 1.4])])
def test_a_figure_that_is_longer_one_way_is_no_square(seen_as):
    figure = figure_for(COARSE)
    words = refusal(see_figure, figure_image(figure, seen_as), figure, COARSE)
    assert "1.40 times as long one way as the other" in words


@pytest.mark.parametrize("lights", [(9.0, 4.0, 4.0), (9.0, 9.0, 1.0)])
def test_two_squares_of_one_light_are_not_told_apart(lights):
    figure = figure_for(COARSE)
    with pytest.raises(SquaresAlike, match="cannot be told apart"):
        see_figure(figure_image(figure, np.eye(2), lights), figure, COARSE)


@pytest.mark.parametrize("off_px", [(0, 110), (0, 130), (0, -130), (150, 0), (170, 0), (-170, 0)])
def test_a_figure_is_where_the_tracker_looks_unless_that_is_a_quarter_of_the_screen_off(off_px):
    """Of 640 x 480 px: 160 and 120."""
    middle = np.array([319.5, 239.5])
    axis_px = middle + off_px
    monitor = replace(GEOMETRY.monitor, principal_point_px=tuple(axis_px.tolist()))
    figure = figure_for(BenchGeometry(monitor, GEOMETRY.tracker))
    is_near = abs(off_px[0]) < 160 and abs(off_px[1]) < 120
    # the corner is at one end of both sides, the others are at the other end of one
    found = (
        np.ptp(figure.x_px) / 2 + figure.x_px.min(),
        np.ptp(figure.y_px) / 2 + figure.y_px.min(),
    )
    assert found == pytest.approx(axis_px if is_near else middle, abs=1.0)


@pytest.mark.parametrize(("turn_deg", "is_oblique"), [(41, 1), (-41, 1), (39, 0), (-39, 0)])
def test_a_figure_is_oblique_turned_either_way(turn_deg, is_oblique):
    assert _is_oblique((SimpleNamespace(turn_deg=turn_deg), None)) == is_oblique


@pytest.mark.parametrize("key", keys_of_ways())
def test_a_key_says_where_the_squares_of_its_way_round_are(key):
    way = keys_of_ways()[key]
    corner, right, below = (
        np.array(way).reshape(2, 2) @ place for place in ([-1, -1], [1, -1], [-1, 1])
    )
    words = look_of(way)
    assert (
        f"largest square {'top' if corner[1] < 0 else 'bottom'}"
        f" {'left' if corner[0] < 0 else 'right'}," in words
    )
    sides = {
        (2, 0): "to its right",
        (-2, 0): "to its left",
        (0, 2): "below it",
        (0, -2): "above it",
    }
    assert (
        f"next one {sides[tuple(right - corner)]}, the smallest {sides[tuple(below - corner)]}"
        in words
    )


def test_a_detector_that_is_clipped_at_zero_beyond_the_screen_s_glow_sees_the_figure():
    """Six tenths of the image have no noise at all, as where an ADC without offset sees no
    screen.
    """
    figure = figure_for(GEOMETRY)
    image = np.rint(spots(figure, UPRIGHT) + np.random.default_rng(2).normal(0, 1.5, (400, 400)))
    image[:, :60], image[:, 340:], image[:60], image[340:] = 0, 0, 0, 0
    assert (image == 0).mean() > 0.5
    assert see_figure(image, figure, GEOMETRY).way == UPRIGHT


@pytest.mark.parametrize("sigma_px", [2.4, 3.5])
def test_squares_are_told_apart_by_light_through_a_wide_psf(sigma_px):
    """Of 2.4 px and more spots of squares of 1, 2 and 3 sides have nearly as many pixels above
    the noise.
    """
    figure, noise = figure_for(GEOMETRY), np.random.default_rng(3).normal(0, 1.0, (400, 400))
    way = (0, -1, 1, 0)
    image = 6 * gaussian_filter(spots(figure, way), sigma_px) + noise
    assert see_figure(image, figure, GEOMETRY).way == way


def test_an_upright_figure_leaves_the_mounting_alone():
    for mounting in MOUNTINGS:
        assert corrected(mounting, (1, 0, 0, 1)) == mounting


@pytest.mark.parametrize(
    ("image", "words"),
    [("nothing", "squares"), ("alike", "told apart"), ("small", "times as large")],
)
def test_an_image_without_the_figure_is_refused(image, words):
    figure = figure_for(GEOMETRY)
    data = np.random.default_rng(1).normal(0, 1.0, (400, 400))
    for x, y, side in {
        "alike": [(50, 50, 6), (300, 50, 6), (50, 300, 6)],
        "small": [(190, 190, 9), (212, 190, 6), (190, 212, 3)],
    }.get(image, []):
        data[y : y + side, x : x + side] += 500
    with pytest.raises(InputError, match=words):
        see_figure(data, figure, GEOMETRY)


@pytest.mark.parametrize("sigma_px", [0.4, 0.55, 0.8, 1.3, 2.0])
def test_sharpness_is_the_sigma_of_the_psf(sigma_px):
    rng = np.random.default_rng(3)
    image, side = rng.normal(0, 3.0, (400, 400)), 2.77
    steps = (np.arange(31) + 0.5) / 31 * side - side / 2
    pixels = np.arange(400)
    for x, y in np.stack(np.meshgrid(*[np.linspace(40, 360, 7)] * 2), -1).reshape(
        -1, 2
    ) + rng.uniform(-0.5, 0.5, (49, 2)):
        across, down = (
            (
                ndtr((pixels[:, None] + 0.5 - c - steps) / sigma_px)
                - ndtr((pixels[:, None] - 0.5 - c - steps) / sigma_px)
            ).mean(1)
            for c in (x, y)
        )
        image += 30_000 * np.outer(down, across)
    holds("first-light-psf", abs(sharpness(image, side).psf_sigma_px - sigma_px))


class RecordedWindow:
    """A window that lists itself as the open one, and leaves the list when it is closed."""

    opened: list[RecordedWindow]

    def __init__(self, settings: windows.WindowSettings) -> None:
        self.settings = settings
        self.opened.append(self)

    def make_current(self) -> None:
        """Nothing is drawn."""

    def close(self) -> None:
        self.opened.remove(self)


def test_patterns_have_a_window_of_their_own_screen_s_size_and_keep_it_while_that_stays(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(windows, "Window", RecordedWindow)
    RecordedWindow.opened = []
    screens = [
        ({}, (320, 240)),
        ({"rotate_deg": 180}, (320, 240)),
        ({"rotate_deg": 90}, (240, 320)),
        ({"resolution_px": [640, 480]}, (640, 480)),
    ]
    with PatternDisplay() as shown:
        window_of_size: dict[tuple[int, int], RecordedWindow] = {}
        for keys, size_px in screens:
            window = shown._window_for(filed_bench(tmp_path, {"monitor": keys}))
            assert window is window_of_size.setdefault(size_px, window)
            assert RecordedWindow.opened == [window]
            assert window.settings.resolution_px == size_px
    assert RecordedWindow.opened == []


def grabbed(tmp_path, command):
    (tmp_path / "bench.toml").write_text(bench_text())
    pattern = Pattern("figure_000", black((320, 240)))
    return GrabCommand(command).look(
        read_bench_file(tmp_path / "bench.toml"), pattern, tmp_path / "figure_000", 0.0123456789
    )


def test_a_command_gets_the_pattern_and_writes_the_image(tmp_path):
    path = grabbed(tmp_path, "cp {pattern} {output}")
    assert path == tmp_path / "figure_000.png"
    assert path.read_bytes() == (tmp_path / "pattern.png").read_bytes()


def test_a_command_is_told_the_exposure_and_must_write_a_new_image(tmp_path):
    (tmp_path / "figure_000.png").write_bytes(b"of an attempt that was interrupted")
    with pytest.raises(NoImage, match="wrote no image"):
        grabbed(tmp_path, "true {pattern} {output}")
    path = grabbed(tmp_path, "sh -c 'echo {exposure_s} > {output}' {pattern}")
    assert path.read_text() == "0.0123456789\n"


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (
            (
                f"{shlex.quote(sys.executable)} -c \"import sys; sys.exit('no camera on bus 3')\" {{pattern}}"
                " {output}"
            ),
            "no camera on bus 3",
        ),
        ("true {pattern} {output}", "wrote no image"),
        ("touch {output} {pattern}", "wrote no image"),
        ("sh -c 'yes {pattern} {output} >&2'", "printed more than 4 MB"),
        ("no-such-command-here {pattern} {output}", "cannot be run"),
        ("cp {pattern} here.png", "has no {output}"),
        ("cp '{pattern} {output}", "quotes in pairs"),
    ],
)
def test_a_command_that_fails_says_why(tmp_path, command, words):
    with pytest.raises(InputError, match=words):
        grabbed(tmp_path, command)


class Blind(ImageSource):
    """Eyes for steps that take no image."""

    identity = "blind"


class Counted:
    """Steps that count how often they ran; `failing` are refused."""

    def __init__(self):
        self.runs, self.failing = [], set()
        steps = (
            SessionStep("", "", "", name="first", tables=("monitor",), writes=("monitor.flip_x",)),
            SessionStep("", "", "", name="second", needs=("first",), tables=("monitor",)),
            SessionStep("", "", "", name="third", tables=("collimator",)),
        )
        self.plan = SessionPlan(steps, {step.name: self.step(step.name) for step in steps})

    def step(self, name):
        def run(context):
            self.runs.append(name)
            if name in self.failing:
                raise InputError("it is not there")
            path = context.session / f"{name}.txt"
            path.write_text(name)
            now = context.file.config.monitor.flip_x
            changes = (
                (KeyChange(table="monitor", key="flip_x", before=now, after=True),)
                if name == "first" and not now
                else ()
            )
            return StepOutcome("done", "found", files=(path,), changes=changes)

        return run

    def go(self, folder, again=()):
        self.runs.clear()
        file = read_bench_file(folder / "bench.toml")
        session = FirstLightSession(folder / "s", file, Blind(), 0, plan=self.plan)
        return session.run(frozenset(again), lambda line: None), session


@pytest.fixture
def counted(tmp_path):
    (tmp_path / "bench.toml").write_text(bench_text())
    (tmp_path / "s").mkdir()
    return Counted()


def test_steps_run_once_and_again_when_asked_or_when_what_they_depend_on_changes(counted, tmp_path):
    assert counted.go(tmp_path)[0] == 0
    assert counted.runs == ["first", "second", "third"]
    assert "flip_x = true" in (tmp_path / "bench.toml").read_text()
    assert counted.go(tmp_path)[0] == 0
    assert counted.runs == []
    counted.go(tmp_path, again=["second"])
    assert counted.runs == ["second"]
    (tmp_path / "s" / "third.txt").write_text("other")
    counted.go(tmp_path)
    assert counted.runs == ["third"]
    file = tmp_path / "bench.toml"
    file.write_text(file.read_text().replace("[320, 240]", "[640, 480]"))
    counted.go(tmp_path)
    assert counted.runs == ["first", "second"]


def test_a_step_runs_again_where_a_key_that_it_set_is_changed_by_hand(counted, tmp_path):
    """And no step before it: to them a later step's keys are nothing."""
    counted.go(tmp_path)
    file = tmp_path / "bench.toml"
    text = file.read_text()
    assert "flip_x = true" in text
    file.write_text(text.replace("flip_x = true", "flip_x = false"))
    counted.go(tmp_path)
    # `second` depends on the whole of [monitor], and on what `first` set there
    assert counted.runs == ["first"]
    assert file.read_text() == text
    file.write_text(text.replace("flip_x = true", "flip_x = true\nflip_y = true"))
    counted.go(tmp_path)
    assert counted.runs == ["first", "second"]


def test_a_session_knows_the_beat_by_what_it_has_seen_of_the_display(counted, tmp_path):
    tables = {
        "tracker": {"exposure_s": 0.04},
        "collimator": {"focal_length_mm": 350},
        "render": {"tolerance_px": 0.02},
    }
    (tmp_path / "bench.toml").write_text(bench_text(tables))
    session = counted.go(tmp_path)[1]
    assert session.as_file().beat.refreshes_per_exposure == pytest.approx(2.4)
    assert session.as_file().beat.proposal.refresh_hz == pytest.approx(50)
    seen = StepOutcome(
        "done", "a frame every 13.4 ms", {"refresh_hz": 74.6, "modes_hz": "50 60 75"}
    )
    session.records["display"] = structs.replace(
        session.records["first"], name="display", figures=dict(seen.figures)
    )
    assert session.beat().refreshes_per_exposure == pytest.approx(2.984)
    assert not session.beat().matters
    session.records["display"] = structs.replace(
        session.records["display"], figures={"refresh_hz": 59.9, "modes_hz": "60 70 75"}
    )
    assert session.beat().proposal.refresh_hz == 75.0


def test_what_failed_is_never_done_and_what_needs_it_is_skipped(counted, tmp_path):
    counted.failing = {"first"}
    code, session = counted.go(tmp_path)
    assert code == 1
    assert {name: record.verdict for name, record in session.records.items()} == {
        "first": "failed",
        "second": "skipped",
        "third": "done",
    }
    assert session.records["first"].line == "it is not there"
    counted.failing = set()
    assert counted.go(tmp_path)[0] == 0
    assert counted.runs == ["first", "second"]


def test_a_camera_that_fails_once_does_not_cost_the_images_before_it(tmp_path):
    """The third image fails until a file is there; then only it and what follows are taken, and
    afterwards nothing is. A step that is asked for anew takes all of them.
    """
    (tmp_path / "bench.toml").write_text(bench_text())
    (tmp_path / "s").mkdir()
    taken = []

    def frames(context):
        for number in range(4):
            path = context.take(Pattern(f"frame_{number}", black(context.resolution_px)))
            taken.append((path.name, path.stat().st_mtime_ns))
        return StepOutcome("done", "found")

    step = SessionStep("", "", "", name="frames", tables=("monitor",))
    plan = SessionPlan((step,), {"frames": frames})
    grab = (
        "sh -c 'cp {pattern} {output}; case {output} in *frame_2*) test -e"
        f" {tmp_path / 'mended'};; esac'"
    )

    def go(*again):
        taken.clear()
        file = read_bench_file(tmp_path / "bench.toml")
        session = FirstLightSession(tmp_path / "s", file, GrabCommand(grab), 0, plan=plan)
        code = session.run(frozenset(again), lambda line: None)
        return code, session.records["frames"].verdict, dict(taken)

    code, verdict, before = go()
    assert (code, verdict, sorted(before)) == (1, "failed", ["frame_0.png", "frame_1.png"])
    code, verdict, anew = go("frames")
    assert (code, sorted(anew)) == (1, sorted(before))
    assert not anew.items() & before.items()
    (tmp_path / "mended").touch()
    code, verdict, after = go()
    assert (code, verdict, len(after)) == (0, "done", 4)
    assert after.items() >= anew.items()
    assert go()[2] == {}
    assert not go("frames")[2].items() & after.items()


def test_what_a_killed_session_was_writing_is_cleared_when_it_goes_on(counted, tmp_path):
    images = tmp_path / "s" / "images" / "geometry-1"
    images.mkdir(parents=True)
    litter = [
        ".frame_005.10368.part.png",
        ".frame_005.0123456789abcdef.part.png",
        ".session.fedcba9876543210.part.json",
    ]
    own = [".notes.part.png", "frame_004.png", "part.10.part.png"]
    for name in (*litter, *own):
        (images / name).touch()
    assert counted.go(tmp_path)[0] == 0
    assert sorted(path.name for path in images.iterdir()) == sorted(own)


def test_a_directory_of_another_bench_is_refused(counted, tmp_path):
    counted.go(tmp_path)
    (tmp_path / "other.toml").write_text(bench_text())
    with pytest.raises(InputError, match="write another directory"):
        FirstLightSession(tmp_path / "s", read_bench_file(tmp_path / "other.toml"), Blind(), 0)


@pytest.mark.parametrize("data", [b"{}", *NO_JSON, b'{"kind": "\xff"}'])
def test_a_session_file_that_is_none_is_refused(counted, tmp_path, data):
    (tmp_path / "s" / "session.json").write_bytes(data)
    assert "is no session" in refusal(counted.go, tmp_path)


def test_a_session_file_of_another_kind_is_refused(counted, tmp_path):
    counted.go(tmp_path)
    path = tmp_path / "s" / "session.json"
    path.write_text(path.read_text().replace('"kind": "', '"kind": "another '))
    assert "kind = 'another " in refusal(counted.go, tmp_path)


def test_a_key_that_cannot_be_set_leaves_the_file_alone(tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(bench_text({"monitor": {"flip_x": None}}).replace("[monitor]", "[ monitor ]"))
    before = path.read_text()
    change = KeyChange(table="monitor", key="flip_x", before=False, after=True)
    with pytest.raises(InputError, match=r"bench\.toml"):
        rewrite(read_bench_file(path), [change])
    assert path.read_text() == before
