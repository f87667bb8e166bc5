"""The benchmark: its rows, its comparison, its files, and what it refuses."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from hilstar.basics.errors import InputError
from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.instruments.study.speed import benchmark, tracker
from hilstar.instruments.study.speed.benchmark import RADEC_ROLL_DEG, STAGES, numpy_linear, scene
from hilstar.instruments.study.sweep import Load
from hilstar.optics.sprites import pack_sprites
from tests.support.commands import assert_refused, run_hilstar_here, run_started
from tests.support.tables import csv_rows

Q = from_radec_roll_deg(*RADEC_ROLL_DEG)
# A minimum needs no 30 rounds, and a start no second one.
FEWER_ROUNDS = """
from dataclasses import replace
from hilstar.__main__ import main
from hilstar.instruments.study.speed import benchmark
benchmark.QUICK = replace(benchmark.QUICK, starts=1, rounds=8, budget_s=0.4)
main()
"""
GRID = ("--stars", "100,1000", "--sizes", "640x480")
# The stages are timed with a wait after each and without the frame's bookkeeping; a wrong unit or a
# stage left out or counted twice is off by more.
SUM_FACTOR = 3.0
# Ten stars on one pixel, each float32 sum and each share (erf of the GPU, 1.2e-6) at its worst, of
# the brightest pixel.
FLOAT32_OF_PEAK = 1e-5


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bench") / "out"
    result = run_started(
        [
            sys.executable,
            "-c",
            FEWER_ROUNDS,
            "benchmark",
            "--quick",
            *GRID,
            "--json",
            "-o",
            str(folder),
        ]
    )
    assert result.returncode == 0, result.stderr
    assert len(result.stdout.splitlines()) == 1
    return json.loads(result.stdout), folder


def drawn_stages(result) -> set[str]:
    """The stages of the way that draws here: a processor uploads nothing."""
    kinds = {row["kind"] for row in result["rows"]}
    return set(STAGES) if "upload" in kinds else set(STAGES) - {"upload"}


def test_rows_are_those_of_the_contract(measured):
    result, _ = measured
    assert result["machine"]["cores"] >= 1
    assert result["gl_renderer"]
    for row in result["rows"]:
        assert (row["width"], row["height"]) == (640, 480)
        assert 0 < row["ms"]["min"] <= row["ms"]["median"] <= row["ms"]["max"]
    for count in (100, 1000):
        kinds = [
            row["kind"]
            for row in result["rows"]
            if row["stars"] == count and row["method"] == "hilstar"
        ]
        assert kinds.count("whole_frame") == kinds.count("turning") == 1
        assert drawn_stages(result) < set(kinds)
        assert [
            row["kind"]
            for row in result["rows"]
            if row["stars"] == count and row["method"] == "numpy"
        ] == ["linear_only"]
    assert min(result[name] for name in ("import_ms", "first_frame_ms", "memory_mb")) > 0
    assert {row["method"] for row in result["agreement"]} >= {"numpy"}
    assert all(
        row["worst_of_peak"] < FLOAT32_OF_PEAK
        for row in result["agreement"]
        if row["method"] == "numpy"
    )


def test_each_count_is_judged_turning_against_still_and_beside_numba(measured):
    result, _ = measured
    at = {(row["stars"], row["method"], row["kind"]): row["ms"]["median"] for row in result["rows"]}
    aims = {aim["what"]: aim for aim in result["aims"]}
    for count in (100, 1000):
        turning = aims[f"turning by 10 deg/s, {count} stars, 640 x 480, 2 still frames"]
        assert turning["aim_ms"] == 2 * at[count, "hilstar", "whole_frame"]
        reached = at[count, "hilstar", "turning"] <= turning["aim_ms"]
        assert turning["reached"] == (None if Load(result["others_cores"]).busy else reached)
        beside = aims.get(f"linear image, {count} stars, 640 x 480, numba's time")
        assert (beside and beside["aim_ms"]) == at.get((count, "numba", "linear_only"))


@pytest.mark.timing
def test_stages_make_up_the_whole_frame():
    counts = (100, 1000)
    plan = replace(benchmark.QUICK, counts=counts, starts=1, exposures=0)
    result = benchmark.run(plan, np.random.default_rng(1), lambda cells_done: None)
    for count in counts:
        # The minimum: what else the machine has to do is in the median.
        ms = {
            row.kind: row.ms.min
            for row in result.rows
            if row.stars == count and row.method == "hilstar"
        }
        stages = set(STAGES) & set(ms)
        assert len(stages) >= len(STAGES) - 1
        total = sum(ms[stage] for stage in stages)
        assert 1 / SUM_FACTOR < total / ms["whole_frame"] < SUM_FACTOR


def test_every_way_is_measured_or_named_with_what_to_install(measured):
    result, _ = measured
    run = {row["method"] for row in result["rows"] + result["tracker"]}
    skipped = {row["method"]: row["why"] for row in result["skipped"]}
    assert run | set(skipped) == {"hilstar", "numpy", "numba", "galsim", "photutils", "sep"}
    assert all("hilstar[benchmark]" in why or "budget" in why for why in skipped.values())


def test_the_catalogue_is_filled_up_and_that_is_said(measured):
    result, _ = measured
    for row in result["scenes"]:
        assert row["catalogue"] + row["random"] == row["stars"]
    assert [row["random"] > 0 for row in result["scenes"]] == [False, True]


def test_the_files_say_the_same(measured):
    result, folder = measured
    rows = csv_rows(folder / "bench.csv")
    assert [float(row["median_ms"]) for row in rows] == [
        row["ms"]["median"] for row in result["rows"]
    ]
    with Image.open(folder / "bench.png") as picture:
        assert picture.width > 500


def test_the_virtual_tracker_is_timed_beside_its_peers(measured):
    result, folder = measured
    kinds = {(row["method"], row["kind"]) for row in result["tracker"]}
    assert {("hilstar", kind) for kind in ("exposure", "find_stars", "case", "verify")} | {
        ("numpy", "exposure")
    } <= kinds
    rows = csv_rows(folder / "tracker.csv")
    assert [float(row["median_ms"]) for row in rows] == [
        row["ms"]["median"] for row in result["tracker"]
    ]


def test_a_bench_file_is_measured_at_its_own_size(small_bench_file, monkeypatch):
    fewer = replace(benchmark.QUICK, starts=1, rounds=2, budget_s=0.1, exposures=0)
    monkeypatch.setattr(benchmark, "QUICK", fewer)
    result = run_hilstar_here("benchmark", small_bench_file, "--quick", "--stars", "50")
    assert result.returncode == 0, result.stderr
    assert "320 x 240" in result.stdout
    assert "hilstar, whole frame" in result.stdout


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--stars", "many"), ("--stars many", "100,1000")),
        (("--stars", "0"), ("--stars 0", "from 1")),
        (("--stars", "9999999999"), ("--stars", "200000")),
        (("--sizes", "640"), ("--sizes 640", "640x480")),
        (("--sizes", "99999x10"), ("--sizes 99999x10", "32768")),
        (("nowhere.toml",), ("nowhere.toml",)),
        (("--slow",), ("--slow",)),
    ],
)
def test_wrong_options_are_refused(options, words):
    assert_refused(run_hilstar_here("benchmark", *options), 2, *words)


def test_a_bench_file_and_sizes_exclude_each_other(small_bench_file):
    assert_refused(
        run_hilstar_here("benchmark", small_bench_file, "--sizes", "640x480"),
        2,
        "--sizes",
        "leave out",
    )


def test_a_bench_without_stars_is_refused(small_bench_file):
    with small_bench_file.open("a") as file:
        file.write("[sky]\nfaintest_v_mag = -50\n[render]\nflux_at_white_e_per_s = 1e6\n")
    assert_refused(run_hilstar_here("benchmark", small_bench_file, "--quick"), 2, "faintest_v_mag")


def test_the_numpy_image_is_ours(bench_with):
    bench = bench_with("[render]\nsprite_sigma_px = [0.7, 1.3]\n")
    sprites = bench.sprites(Q, bench.stars)
    ours = bench.frame(Q).linear
    theirs = numpy_linear(sprites, bench.config.render.sprite_sigma_px, ours.shape)
    assert len(sprites) > 10
    assert np.abs(theirs - ours).max() < FLOAT32_OF_PEAK * ours.max()


@pytest.mark.parametrize("count", [1, 5, 3000])
def test_a_scene_has_exactly_the_stars_asked_for(bench_with, rng, count):
    bench = bench_with()
    found = scene(bench, bench.shown_stars, Q, count, rng)
    stars = found.stars
    assert len(bench.sprites(Q, stars)) == count
    assert found.catalogue_count == min(count, len(bench.sprites(Q)))
    assert np.allclose(np.linalg.norm(stars.vectors, axis=1), 1)


def test_slow_works_take_fewer_turns_evenly(monkeypatch):
    taken = []

    def seconds(work):
        taken.append(work())
        return {"fast": 0.001, "slow": 1.0, "slowest": 9.0}[taken[-1]]

    monkeypatch.setattr(benchmark, "_seconds", seconds)
    works = {name: lambda name=name: name for name in ("fast", "slow", "slowest")}
    times = benchmark.interleaved(works, rounds=8, budget_s=5.0)
    # One turn of the slow work's five goes ahead; the slowest has no other turn, so that one
    # counts.
    assert {name: len(values) for name, values in times.items()} == {
        "fast": 8,
        "slow": 4,
        "slowest": 1,
    }
    assert taken[3:] == ["fast", "fast", "slow"] * 4


def test_a_timed_tracker_is_freed_where_its_campaign_cannot_begin(monkeypatch):
    freed = []

    class Exposing:
        """The works of a tracker whose session is refused."""

        def __init__(self, file, folder):
            self.simulator = SimpleNamespace(close=lambda: freed.append(folder))

        def session(self):
            raise InputError("its bench is another one's")

    monkeypatch.setattr(tracker, "Exposing", Exposing)
    with pytest.raises(InputError):
        tracker.tracker_rows(1, 0.0)
    assert len(freed) == 1
    assert not freed[0].exists()


def test_random_stars_end_with_the_last_that_is_wanted_in_view(bench_with):
    """By any chance: as many in view as are wanted, the last of all among them, unit vectors."""
    bench = bench_with()
    camera, side_px = bench.camera, bench.psf.footprint_px
    icrs_to_image = camera.cam_to_image @ to_matrix(Q)
    for seed in range(12):
        vectors = benchmark._directions(bench, Q, 5, np.random.default_rng(seed))
        np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0)
        x_px, y_px = camera.project(vectors @ icrs_to_image.T)
        width, height = camera.resolution_px
        margin_px = side_px / 2 + 1
        near = (x_px > -margin_px) & (x_px < width - 1 + margin_px)
        near &= (y_px > -margin_px) & (y_px < height - 1 + margin_px)
        # within a pixel of the edge of its sprite a star may be in view or not
        assert near.sum() >= 5 and near[-1]
        sure = (x_px > 0) & (x_px < width - 1) & (y_px > 0) & (y_px < height - 1)
        assert sure.sum() <= 5


def test_the_plain_loop_that_is_compiled_draws_the_same_stars(rng):
    """On an image that is no square, with sigmas that differ, over its edges."""
    x_px, y_px = rng.uniform(-3, 43, 30), rng.uniform(-3, 27, 30)
    flux = rng.uniform(1, 9, 30)
    sprites = pack_sprites(x_px, y_px, flux, np.arange(30), (40, 24), 9)
    sigma_px = (0.7, 1.1)
    wanted = numpy_linear(sprites, sigma_px, (24, 40))
    image = np.zeros((24, 40))
    first = sprites.data["pixel"] - 4
    centre_px = np.stack([sprites.x_px, sprites.y_px])
    scale = 1 / (np.array(sigma_px) * np.sqrt(2))
    light = sprites.data["electrons_per_s"]
    benchmark._add_stars(image, first, centre_px, light, scale, 9)
    np.testing.assert_allclose(image, wanted, atol=1e-5)
    assert wanted.sum() > 50
