"""A bench by chance through first light and verify, as tools/any_bench.py takes it, the smallest that was calibrated."""

from __future__ import annotations

import pytest

from tests.support.any_bench.draw import drawn_bench, write_bench
from tests.support.any_bench.judge import FIRST_LIGHT, GOOD_OUTCOMES, MAX_SIGMAS, VERIFY, CommandResult, comparisons, outcome_of
from tests.support.commands import run_hilstar_here

SEED = 1
# A microdisplay of which the tracker sees 2 %, before 256 x 256 pixels with a PSF of 2.1 px.
NUMBERS = (16,)


@pytest.mark.e2e
@pytest.mark.usefixtures("without_charts")
@pytest.mark.parametrize("number", NUMBERS)
def test_a_bench_by_chance_is_calibrated_and_each_figure_is_within_its_error(tmp_path, number):
    bench = drawn_bench(SEED, number)
    write_bench(bench, tmp_path)
    words = {
        FIRST_LIGHT: ("bench.toml", "-o", "session", "--virtual", "truth.toml", "--json"),
        VERIFY: ("bench.toml", "--json"),
    }
    results = {}
    for name, more in words.items():
        ended = run_hilstar_here(name, *more, cwd=tmp_path)
        results[name] = CommandResult(ended.returncode, 0.0, 0.0, 0.0, ended.stdout, ended.stderr)
    steps = {step["name"]: step for step in results[FIRST_LIGHT].found["steps"]}
    compared = comparisons(bench, tmp_path, steps)
    assert {"focus", "geometry", "photometry", "scale"} <= compared.keys()
    assert all(abs(one.sigmas) < MAX_SIGMAS for one in compared.values() if one.sigmas is not None)
    assert outcome_of(results, compared)[0] in GOOD_OUTCOMES
