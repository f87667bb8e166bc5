"""Benches of few pixels, drawn by chance, through first light and verify, as tools/any_bench.py
takes them.
"""

from __future__ import annotations

import pytest

from tests.support.any_bench.draw import drawn_bench, write_bench
from tests.support.any_bench.judge import (
    FIRST_LIGHT,
    MAX_SIGMAS,
    VERIFIED,
    VERIFY,
    CommandResult,
    comparisons,
    outcome_of,
)
from tests.support.commands import run_hilstar_here

SEED = 48
# A PSF of 2.0 px, and stars enough for the twin.
WHOLE_NUMBER = 17
# What each is there for.
NUMBERS = {
    7: "seen twice over, a PSF of 0.36 px, a black level of 8e-4, hot pixels",
    21: "a PSF of 0.37 px before a pixel of 0.31: dots lie within a tracker pixel",
    22: "an S-curve and a wide field",
    39: "a pixel of 2.7 tracker pixels, on its side and mirrored, of which 3 % is seen",
    41: "a black level in read noise of 0.12 DN",
}
# An ADC hides a part of its glow, which the response's error says: the twin judges it no closer.
ROUNDED_BLACK = 41
# Whose dots' places within a pixel made its geometry 0.45 arcsec wrong, where noise makes 0.05.
SHARP, SHARP_ARCSEC = 21, 0.1
MEASURED = {"focus", "geometry", "uniformity", "photometry", "scale"}


def results_of(bench, folder, commands):
    """What the commands of a bench print, by their names."""
    write_bench(bench, folder)
    words = {
        FIRST_LIGHT: ("bench.toml", "-o", "session", "--virtual", "truth.toml", "--json"),
        VERIFY: ("bench.toml", "--json"),
    }
    results = {}
    for name in commands:
        ended = run_hilstar_here(name, *words[name], cwd=folder)
        results[name] = CommandResult(ended.returncode, 0.0, 0.0, 0.0, ended.stdout, ended.stderr)
    return results


@pytest.mark.e2e
@pytest.mark.usefixtures("without_charts")
def test_a_bench_by_chance_is_calibrated_and_each_figure_is_within_its_error(tmp_path):
    bench = drawn_bench(SEED, WHOLE_NUMBER, is_small=True)
    results = results_of(bench, tmp_path, (FIRST_LIGHT, VERIFY))
    steps = {step["name"]: step for step in results[FIRST_LIGHT].found["steps"]}
    compared = comparisons(bench, tmp_path, steps)
    assert compared.keys() >= MEASURED
    assert all(abs(one.sigmas) < MAX_SIGMAS for one in compared.values() if one.sigmas is not None)
    assert outcome_of(results, compared)[0] == VERIFIED


@pytest.mark.e2e
@pytest.mark.usefixtures("without_charts")
@pytest.mark.parametrize("number", NUMBERS)
def test_each_figure_of_a_small_bench_is_within_its_error(tmp_path, number):
    bench = drawn_bench(SEED, number, is_small=True)
    results = results_of(bench, tmp_path, (FIRST_LIGHT,))
    steps = {step["name"]: step for step in results[FIRST_LIGHT].found["steps"]}
    assert all(steps[name]["verdict"] == "done" for name in ("orientation", *MEASURED))
    compared = comparisons(bench, tmp_path, steps)
    assert compared.keys() >= MEASURED
    off = {name: one.sigmas for name, one in compared.items() if one.sigmas is not None}
    assert all(abs(sigmas) < MAX_SIGMAS for sigmas in off.values()), off
    if number == SHARP:
        assert compared["geometry"].found < SHARP_ARCSEC
    if number in (ROUNDED_BLACK, SHARP):
        assert steps["verify"]["verdict"] == "done", steps["verify"]["line"]
