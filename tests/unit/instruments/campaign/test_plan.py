"""Plans: what a design and its parameters make of a case's number."""

from __future__ import annotations

import json
import math
import re
import tomllib
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from hilstar.basics.rotation import to_matrix
from hilstar.instruments.campaign.cases import CaseMaker
from hilstar.instruments.campaign.plan import (
    Design,
    Parameter,
    Plan,
    Require,
    changed_bench,
    check_require,
    checked_conditions,
    parse_plan,
    read_plan,
)
from hilstar.server.bench.bench_file import read_bench_file
from tests.support.campaigns import plan_text, write_campaign
from tests.support.refusals import refusal

PSF: dict[str, Any] = {"key": "tracker.psf_sigma_px", "minimum": 0.5, "maximum": 1.0}


@pytest.mark.parametrize("sampling", ["sobol", "latin-hypercube", "grid"])
def test_a_designs_points_do_not_depend_on_how_they_are_asked_for(sampling: Any) -> None:
    levels = [3, 4] if sampling == "grid" else [1, 1]
    whole = Design(sampling, 5, 40, 3, levels).points(0, 40)
    other = Design(sampling, 5, 40, 3, levels)
    parts = [other.points(30, 40), other.points(0, 7), other.points(7, 30)]
    assert np.array_equal(np.concatenate([parts[1], parts[2], parts[0]]), whole)
    assert whole.shape == (40, 5) and whole.min() >= 0 and whole.max() < 1
    assert not np.array_equal(Design(sampling, 6, 40, 3, levels).points(0, 40), whole)


def test_a_latin_hypercube_has_one_case_in_each_stratum_and_a_grid_each_node_once() -> None:
    cube = Design("latin-hypercube", 1, 50, 3, [1]).points(0, 50)
    assert all(sorted(np.floor(50 * column)) == list(range(50)) for column in cube.T)
    grid = Design("grid", 1, 12, 0, [3, 4]).points(0, 12)
    assert len({tuple(np.floor(point * [3, 4])) for point in grid}) == 12


def test_a_latin_hypercube_beyond_the_values_that_it_may_hold_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of four dimensions 200 values are 50 cases."""
    monkeypatch.setattr("hilstar.instruments.campaign.plan.MAX_HYPERCUBE_VALUES", 200)
    assert Design("latin-hypercube", 1, 50, 3, [1]).points(0, 50).shape == (50, 4)
    line = refusal(Design, "latin-hypercube", 1, 51, 3, [1])
    assert "cases = 51: a Latin hypercube is made as a whole, of at most 50 cases with 4" in line
    assert line.endswith('with 4 dimensions; write sampling = "sobol"')


def test_a_plan_that_writes_no_more_than_it_must_is_as_its_page_says(tmp_path: Path) -> None:
    """The defaults of the tables of keys of docs/campaign.md."""
    page = Path(__file__).parents[4] / "docs/campaign.md"
    stated: dict[str, Any] = {}
    for line in page.read_text().splitlines():
        row = re.match(r"\| `(\w+)` \| `([^`]+)`", line)
        if row:
            stated[row[1]] = json.loads(row[2])
    keys = {"bench": "b", "cases": 1, "require": [{"quantity": "bias", "maximum": 1}]}
    plan = msgspec.convert(keys, Plan)
    (require,) = plan.require
    assert stated.pop("answers") == plan.asked
    assert stated.pop("timeout_s") == plan.limit_s
    assert stated.pop("axis") == require.words.split()[1]
    of_require = {key: stated.pop(key) for key in ("confidence", "condition")}
    assert of_require == {key: getattr(require, key) for key in of_require}
    assert set(stated) == {
        *("seed", "sampling", "through", "frames", "step_s", "noise", "wrong_above_arcsec"),
        *("blank_s", "silent_s", "check_every"),
    }
    assert stated == {key: getattr(plan, key) for key in stated}


def test_a_key_by_its_logarithm_stays_within_its_ends(rng: np.random.Generator) -> None:
    """Though a logarithm's exponential may be a rounding off."""
    for low, ratio in rng.uniform([1e-3, 1.1], [10.0, 1e3], (200, 2)).tolist():
        parameter = Parameter("key", (), low, low * ratio, log=True)
        assert low <= parameter.value(0.0) <= low * (1 + 1e-12)
        assert low * ratio * (1 - 1e-12) <= parameter.value(1.0) <= low * ratio


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"quantity": "bias", "maximum": 1.5}, "bias cross at most 1.5 arcsec"),
        ({"quantity": "availability", "minimum": 0.0}, "availability at least 0"),
        (
            {"quantity": "recovery", "maximum": 4, "share": 0.9, "condition": "time_s > 2"},
            "recovery at most 4 s in 90 % of cases where time_s > 2",
        ),
    ],
)
def test_a_requirement_is_named_by_its_figures(keys: dict[str, Any], words: str) -> None:
    require = msgspec.convert(keys, Require)
    check_require("[[require]]", require)
    assert require.words == words


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('rate == "fast"', "rate is no key that the plan varies (rate), and no column of texts"),
        ("why <= 3", "and no column of numbers"),
        ("speed <= 3", "speed is no key"),
    ],
)
def test_a_condition_compares_what_is_there_with_its_kind(text: str, words: str) -> None:
    columns = {"why": "text", "stars": "number", "vary.rate": "number"}
    for fitting in ("rate <= 3 and stars > 2", 'why == ""'):
        assert checked_conditions(fitting, columns)
    assert words in refusal(checked_conditions, text, columns)


def test_one_number_for_a_pair_is_for_both(tmp_path: Path) -> None:
    write_campaign(tmp_path)
    file = read_bench_file(tmp_path / "bench.toml")
    tables = tomllib.loads(file.text)
    for key, pair in (("tracker.psf_sigma_px", (0.7, 0.7)), ("tracker.psf_sigma_px.1", (0.6, 0.7))):
        before = file.config.tracker.psf_sigma_px
        changed = changed_bench(file, tables, {key: 0.7}).config.tracker.psf_sigma_px
        assert changed == (pair if key.endswith("px") else (before[0], 0.7))


def test_values_are_those_of_the_plan_and_reach_the_bench(tmp_path: Path) -> None:
    plan = write_campaign(
        tmp_path,
        PSF | {"steps": 3},
        {"key": "tracker.psf_sigma_px.1", "values": [0.7]},
        {"key": "tracker.detector.bits", "minimum": 8, "maximum": 12, "steps": 2},
        {"key": "sky.spectrum", "values": ["pickles", "blackbody"]},
        {"key": "noise_seed", "values": [5]},
        sampling="grid",
        cases=None,
    )
    maker = CaseMaker(read_plan(plan), read_bench_file(tmp_path / "bench.toml"), tmp_path)
    design = Design("grid", 7, 12, 3, [3, 1, 2, 2, 1])
    cases = [maker.case(k, point) for k, point in enumerate(design.points(0, 12))]
    trackers = [maker.bench(case).config.tracker for case in cases]
    assert sorted({tracker.psf_sigma_px for tracker in trackers}) == [
        (0.5, 0.7),
        (0.75, 0.7),
        (1.0, 0.7),
    ]
    assert {tracker.detector.bits for tracker in trackers} == {8, 12}
    assert {maker.bench(case).config.sky.spectrum for case in cases} == {"pickles", "blackbody"}
    assert {case.noise_seed for case in cases} == {5}
    assert len({maker.bench(case).sha256 for case in cases}) == 12


# Of 4000 even directions: the mean of each component has a sigma of sqrt(1/3 / 4000) = 0.009, and
# five of them are allowed.
EVEN = 5 * math.sqrt(1 / 3 / 4000)


def test_attitudes_are_even_over_the_sky_and_within_the_field(tmp_path: Path) -> None:
    file = read_bench_file(write_campaign(tmp_path).parent / "bench.toml")
    rng = np.random.default_rng(1)
    maker = CaseMaker(read_plan(write_campaign(tmp_path, PSF)), file, tmp_path)
    sky = [to_matrix(maker.case(k, rng.random(4)).first.q_icrs_to_cam)[2] for k in range(4000)]
    assert np.abs(np.mean(sky, axis=0)).max() < EVEN
    assert np.abs(np.mean(np.square(sky), axis=0) - 1 / 3).max() < EVEN
    field = {"kind": "field", "radec_deg": [84.0, -89.0], "radius_deg": 3.0, "roll_deg": [10, 10]}
    maker = CaseMaker(read_plan(write_campaign(tmp_path, PSF, attitudes=field)), file, tmp_path)
    dec, ra = math.radians(-89), math.radians(84)
    middle = np.array([math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)])
    looks = np.array(
        [to_matrix(maker.case(k, rng.random(4)).first.q_icrs_to_cam)[2] for k in range(500)]
    )
    off_deg = np.degrees(np.arccos(np.clip(looks @ middle, -1, 1)))
    assert off_deg.max() <= 3.0 + 1e-6
    # Even over a small cap: half of the cases are beyond radius / sqrt 2; 500 of them have a sigma
    # of 0.022.
    assert abs((off_deg > 3 / math.sqrt(2)).mean() - 0.5) < 5 * 0.5 / math.sqrt(500)


def test_a_quantity_of_further_columns_is_taken_with_them(tmp_path: Path) -> None:
    require = '[[require]]\nquantity = "rate-bias"\nmaximum = 1.0\n'
    plan = parse_plan(tmp_path / "plan.toml", plan_text(columns=["rate"]) + require)
    assert plan.columns == ("rate",)


@pytest.mark.parametrize(
    ("held", "varied", "values"),
    [
        ('epoch_utc = "2026-04-01T00:00:00Z"', "epoch_jyear", [2020.0, 2030.0]),
        ("epoch_jyear = 2026.0", "epoch_utc", ["2020-01-01T00:00:00Z", "2030-01-01T00:00:00Z"]),
    ],
)
def test_a_varied_date_stands_in_the_place_of_the_bench_s(
    tmp_path: Path, held: str, varied: str, values: list[Any]
) -> None:
    plan = write_campaign(tmp_path, {"key": f"sky.{varied}", "values": values})
    bench = tmp_path / "bench.toml"
    text = bench.read_text()
    assert "[sky]" not in text
    bench.write_text(f"{text}\n[sky]\n{held}\n")
    maker = CaseMaker(read_plan(plan), read_bench_file(bench), tmp_path)
    dates = []
    for share in (0.25, 0.75):
        case = maker.case(0, np.append(np.full(maker.attitude_dimensions, 0.5), share))
        dates.append(maker.bench(case).config.sky.epoch_jyear)
    assert dates == pytest.approx([2020.0, 2030.0], abs=0.01)
