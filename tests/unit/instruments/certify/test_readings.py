"""What a virtual bench's instruments read, in closed form: drift and warm-up, the screen's own
light, dots that are far enough apart, a window as wide as they are.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.display.calibration import weights_of_grid
from hilstar.instruments.calibrate.geometric.dots import DOT_PX
from hilstar.instruments.calibrate.geometric.geometry_fit import dot_sigma_px
from hilstar.instruments.certify import readings
from hilstar.instruments.certify.assembly import planned_codes
from hilstar.instruments.certify.bench_readings import (
    BesideRatio,
    geometry_of,
    grey_response,
)
from hilstar.instruments.certify.readings import VirtualReader, dot_places, dot_settings
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.optics.camera import Camera
from hilstar.server.bench.bench_file import BenchFile, read_bench_file
from hilstar.server.bench.build import full_scale_e_per_s
from tests.support.planted_certify import BENCH

QUIET = """[certify.virtual]
reading_noise = 0.0
dot_noise_px = 0.0
drift_percent_per_h = -6.0
cold_percent = 3.0
warm_up_min = 5.0
instrument_error = 0.01
seconds_a_reading = 7.0
"""
# Five fields along and four down, none alike: the middle of the screen is no field's middle.
FIELDS = np.array([[20.0, 19, 18, 16, 13], [19, 20, 18, 15, 12], [17, 18, 19, 15, 11], [15, 15, 16, 12, 9]])  # fmt: skip


def bench(folder: Path, keys: str = "", monitor: str = "", even: bool = False) -> BenchFile:
    """The planted bench with more keys, and with a map of its light."""
    folder.mkdir(exist_ok=True)
    calibration = "srgb"
    if even:
        calibration = "light.toml"
        table = "".join(f"{code},{(code / 255) ** 2.2!r}\n" for code in range(256))
        (folder / "light.csv").write_text("code,w\n" + table)
        np.savetxt(folder / "even.csv", FIELDS / 20, delimiter=",")
        (folder / "light.toml").write_text(
            '[calibration]\nkind = "photometric"\nwho = ""\nwhen = ""\ninstrument = ""\n'
            'unit = ""\nbits = 8\nresponse = "light.csv"\n[uniformity]\nfile = "even.csv"\n'
        )
    text = BENCH.format(calibration=calibration, delay_ms=8.0, geometry="", white=2.6e6)
    path = folder / "bench.toml"
    path.write_text(text.replace("[monitor]\n", f"[monitor]\n{monitor}") + keys)
    return read_bench_file(path)


def even_at(x_px: np.ndarray, y_px: np.ndarray) -> np.ndarray:
    """The map's light at pixels (n,), linear between the middles of its fields."""
    rows = weights_of_grid(1080, len(FIELDS))[y_px]
    columns = weights_of_grid(1920, len(FIELDS[0]))[x_px]
    return np.asarray(np.einsum("nr,rc,nc->n", rows, FIELDS, columns))


def test_light_is_that_of_the_code_at_the_middle_as_the_screen_warms_and_drifts(tmp_path):
    """From 3 % dark, a third of it after five minutes, and 6 % less an hour; 1 % too much by the
    instrument; a reading every 7 s, also from one request to the next.
    """
    truth = bench(tmp_path, QUIET, even=True)
    reader = VirtualReader(truth, truth, 3)
    response = grey_response(truth)
    codes = np.array([255, 0, 40, 255])
    x_px, y_px = np.meshgrid(np.arange(1920), np.arange(1080))
    brightest = even_at(x_px[::8].ravel(), y_px[::8].ravel()).max()  # the screen's, at its corner
    scale = even_at(np.array([960]), np.array([540])) / brightest
    wanted_white = 1.01 * full_scale_e_per_s(truth) * scale
    for begun_s in (0.0, 28.0, 656.0):
        read = reader.light(codes)
        t_s = begun_s + 7.0 * np.arange(4)
        assert read.t_s == pytest.approx(t_s)
        assert reader.now_ns() == round((begun_s + 28) * 1e9)
        warmth = 1 - 0.06 * t_s / 3600 - 0.03 * np.exp(-t_s / 300)
        light = response.light[codes] + response.black
        assert read.light == pytest.approx(light * wanted_white * warmth, rel=1e-6)
        if begun_s:
            reader.wait(600.0)
    ratio = reader.light(codes).beside
    assert ratio == BesideRatio(1.0, 0.0)


def test_each_turn_of_a_virtual_bench_has_noise_of_its_own_that_its_seed_makes_again(tmp_path):
    truth = bench(tmp_path, QUIET.replace("reading_noise = 0.0", "reading_noise = 0.01"))
    codes = np.array([255, 100])
    light, beside = [], []
    for seed, turn in ((3, 0), (3, 0), (3, 1), (4, 0)):
        read = VirtualReader(truth, truth, seed, turn).light(codes)
        light.append(read.light.tolist())
        beside.append(read.beside)
    for figures in (light, beside):
        assert figures[0] == figures[1]
        assert figures[0] != figures[2] != figures[3] != figures[0]


def test_a_dot_is_seen_and_lit_where_the_true_screen_has_it(tmp_path, monkeypatch):
    """A pixel of a screen that is mounted otherwise is another pixel of its true image."""
    file = bench(tmp_path, QUIET, even=True)
    x_px, y_px = np.array([300, 900, 1500, 700]), np.array([200, 100, 900, 600])
    reader = VirtualReader(file, file, 3)
    monkeypatch.setattr(
        readings, "in_true_image", lambda file, truth, x_px, y_px: (1919 - x_px, 1079 - y_px)
    )
    true_px = (1919 - x_px, 1079 - y_px)
    dots = reader.dots(x_px, y_px, 4)
    wanted = even_at(*true_px)
    assert dots.light / dots.light[0] == pytest.approx(wanted / wanted[0])
    assert (dots.x_px.tolist(), dots.y_px.tolist()) == (x_px.tolist(), y_px.tolist())
    seen_px = geometry_of(file).to_tracker(*(at.astype(float) for at in true_px))
    assert np.stack([dots.seen_x_px, dots.seen_y_px]) == pytest.approx(np.stack(seen_px))


def cameras(tracker_focal_px: float, tracker_px: tuple[int, int]) -> BenchGeometry:
    """A screen of 800 by 600 pixels before a tracker, axes on axes."""
    screen = Camera((800, 600), 2000.0, (399.5, 299.5), np.eye(3))
    middle = ((tracker_px[0] - 1) / 2, (tracker_px[1] - 1) / 2)
    return BenchGeometry(screen, Camera(tracker_px, tracker_focal_px, middle, np.eye(3)))


@pytest.mark.parametrize(
    ("focal_px", "size_px", "step_px"),
    [
        (2000.0, (1024, 1024), 12),  # a tracker's pixel for each of the screen's: 12 of its own
        (1000.0, (400, 300), 24),
        (8000.0, (1200, 900), 2 * DOT_PX),  # dots do not touch
        (2000.0, (1024, 1024), 12),
    ],
)
def test_dots_are_apart_for_the_tracker_and_on_the_screen(focal_px, size_px, step_px):
    x_px, y_px = dot_places(cameras(focal_px, size_px))
    for at_px, first in ((x_px, step_px // 2), (y_px, step_px // 2)):
        distinct = np.unique(at_px)
        assert set(np.diff(distinct).tolist()) == {step_px}
        assert (distinct[0] - first) % step_px == 0
    # within eight pixels of the tracker's edges there is none
    ratio = focal_px / 2000
    for at_px, middle, size in ((x_px, 399.5, size_px[0]), (y_px, 299.5, size_px[1])):
        seen_px = (at_px - middle) * ratio + (size - 1) / 2
        assert seen_px.min() > 8
        assert seen_px.max() < size - 9


def test_a_tracker_that_sees_few_dots_is_refused():
    with pytest.raises(InputError, match="dots of the screen and 60 are needed"):
        dot_places(cameras(30_000.0, (700, 700)))


@pytest.mark.parametrize("sigma_px", [0.3, 4.0])
def test_dots_are_measured_in_a_window_no_narrower_than_they_are(tmp_path, sigma_px):
    text = BENCH.format(calibration="srgb", delay_ms=8.0, geometry="", white=2.6e6)
    path = tmp_path / "bench.toml"
    path.write_text(
        text.replace("[tracker]\n", f"[tracker]\npsf_sigma_px = [{sigma_px}, {sigma_px}]\n")
    )
    file = read_bench_file(path)
    window_px = dot_settings(file).window_sigma_px
    assert window_px >= dot_sigma_px(file)
    assert (window_px == dot_sigma_px(file)) == (sigma_px == 4.0)


@pytest.mark.parametrize(
    ("ratio", "error", "excess"),
    [(1.05, 0.03, 0.04), (0.95, 0.03, 0.04), (1.01, 0.02, 0.0), (1.002, 0.0, 0.002)],
)
def test_a_ratio_of_neighbours_is_off_by_what_is_beyond_its_noise(ratio, error, excess):
    assert BesideRatio(ratio, error).excess == pytest.approx(excess)


@pytest.mark.parametrize(
    ("white", "levels", "distinct"),
    [
        # a screen of three bits has no more than seven
        (7, 40, [1, 2, 3, 4, 5, 6, 7]),
        # steps of the fourth root of 255
        (255, 5, [1, 4, 16, 64, 255]),
    ],
)
def test_codes_are_read_in_any_order_with_black_and_white_before_every_eight(
    white, levels, distinct, rng
):
    codes = planned_codes(white, levels, 4, rng)
    count = 4 * len(distinct)
    rounds = -(-count // 8)
    assert len(codes) == count + 2 * (rounds + 1)
    is_between = np.arange(len(codes)) % 10 < 2
    is_between[-2:] = True
    assert codes[is_between].tolist() == [0, white] * (rounds + 1)
    planned = codes[~is_between]
    assert sorted(planned.tolist()) == sorted(4 * distinct)
    assert planned.tolist() != sorted(planned.tolist())
