"""Every figure that README and docs state has a row, a test and an oracle that belong together."""

from __future__ import annotations

import csv
import dataclasses
import datetime
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from hilstar.display.window.output_settings import PITCH_TOLERANCE
from hilstar.instruments.compare import sky_comparison
from hilstar.instruments.confront.report import MAX_RMS_MAG, MAX_RMS_PX
from hilstar.instruments.simulate.star_finder import MATCH_PX
from hilstar.instruments.study.predictors import JITTER
from hilstar.instruments.study.sweep import BUSY_SHARE
from hilstar.optics.layers.bodies import HIDDEN
from hilstar.optics.layers.view import POINT_PX
from hilstar.optics.psf import MAX_NEGATIVE
from hilstar.server.bench.config.hardware import Verify
from hilstar.server.bench.config.render import (
    DEFAULT_TOLERANCE_MAG,
    DEFAULT_TOLERANCE_PX,
    RenderSettings,
)
from hilstar.server.bench.frame_files import MAX_SIP_PX
from hilstar.server.summary import MAX_LATE_SHARE
from tests.support import claims as support
from tests.support.benches import ROOT
from tests.support.claims import faults, holds, rows
from tools import claims as tool

ROW = "star-places"
# pages, tests, and the files that have what is given
COPIED = (
    "docs/*.md",
    "tests/**/*.py",
    "hilstar/**/*.py",
    "tools/*.py",
    "configs/*.toml",
    "configs/*.md",
    "results/*.csv",
)


def test_each_figure_its_row_and_its_test_belong_together():
    assert faults() == []


def test_the_readme_has_the_sum_of_the_rows():
    text = (ROOT / "README.md").read_text()
    assert "<!-- sum of claims -->Of " in text
    assert tool.with_sum(text, tool.claims_of()) == text, "run python tools/claims.py"


def times(name: str, **columns: str) -> list[dict[str, str]]:
    """The rows of results/NAME.csv whose columns have these values."""
    with (ROOT / "results" / f"{name}.csv").open(newline="") as file:
        found = list(csv.DictReader(file))
    return [row for row in found if all(row[key] == value for key, value in columns.items())]


def test_times_are_those_of_the_results():
    frame = {"width": "1920", "height": "1080", "stars": "1000", "kind": "whole_frame"}
    (here,), (card,) = (times(name, **frame, method="hilstar") for name in ("bench", "bench_h100"))
    holds("frame-1000", float(here["median_ms"]))
    holds("frame-1000-h100", float(card["median_ms"]))
    fewest = min(times("scale", axis="packets"), key=lambda row: float(row["at"]))
    holds("frames-share", float(fewest["time"]))
    for workers in ("1", "2"):
        (row,) = times("scale", axis="workers", at=workers)
        holds(f"case-by-{workers}", float(row["time"]))
    (row,) = times("scale", axis="stars", at="1000000")
    holds("memory-of-a-million", float(row["memory_mb"]))


def test_settings_are_those_of_the_code():
    holds("shake", max(size_arcsec for size_arcsec, _ in JITTER))
    for claim in ("lost-star", "match-px"):
        holds(claim, MATCH_PX)
    holds("busy-share", 100 * BUSY_SHARE)
    holds("tolerance-mag", DEFAULT_TOLERANCE_MAG)
    holds("tolerance-px", DEFAULT_TOLERANCE_PX)
    holds("sprite-sigma", max(RenderSettings().sprite_sigma_px))
    verify = Verify()
    holds("verify-mag", verify.flux_mag)
    holds("verify-px", verify.centroid_px)
    holds("verify-lost", 100 * verify.lost_share)
    holds("compare-mag", sky_comparison.FLUX_MAG)
    holds("compare-px", sky_comparison.CENTROID_PX)
    holds("confront-px", MAX_RMS_PX)
    holds("confront-mag", MAX_RMS_MAG)
    holds("disc-px", POINT_PX)
    holds("hidden-share", 100 * HIDDEN)
    holds("negative-share", 100 * MAX_NEGATIVE)
    holds("sip-limit", MAX_SIP_PX)
    holds("pitch-share", 100 * PITCH_TOLERANCE)
    holds("late-share", 100 * MAX_LATE_SHARE)


@pytest.fixture(scope="module")
def whole_copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """README, docs, rows, tests, and the files that have what is given."""
    folder = tmp_path_factory.mktemp("copy")
    names = ["README.md", "claims.toml"]
    for pattern in COPIED:
        names += [path.relative_to(ROOT).as_posix() for path in ROOT.glob(pattern)]
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / name)
    return folder


@pytest.fixture
def falsified(whole_copy: Path) -> Iterator[Callable[[str, str, str], Path]]:
    """The copy with another text for the first of one in a file, which has to have it."""
    texts: dict[Path, str] = {}

    def change(name: str, before: str, after: str) -> Path:
        path = whole_copy / name
        text = texts.setdefault(path, path.read_text())
        assert before in text
        path.write_text(text.replace(before, after, 1))
        return whole_copy

    yield change
    for path, text in texts.items():
        path.write_text(text)


def test_a_true_copy_has_no_fault(whole_copy):
    assert faults(whole_copy) == []


TEST = rows()[ROW].test.partition("::")[0]
CALL = 'holds("star-places", error_mas.max())'


@pytest.mark.parametrize(
    ("name", "before", "after", "fault"),
    [
        ("README.md", "0.007 mas<", "0.006 mas<", "star-places is 0.007 mas, the page has"),
        ("README.md", "0.007 mas<", "10.007 mas<", "star-places is 0.007 mas, the page has"),
        ("README.md", "0.007 mas<", "0.007 arcsec<", "star-places is 0.007 mas, the page has"),
        ("README.md", "claim: star-places", "claim: star-place", "no row of claims.toml is"),
        ("README.md", "0.2 mas<!-- claim: body-places -->", "0.2 mas", "0.2 mas has no mark"),
        ("docs/accuracy-speed.md", "\n## ", "\nIt is 0.3 px off.\n\n## ", "0.3 px has no mark"),
        ("docs/certify.md", "\n## ", "\nIt is 0.3 px off.\n\n## ", "0.3 px has no mark"),
        ("docs/certify.md", "0.2 %<!-- given", "0.3 %<!-- given", "has no 0.3 %"),
        ("docs/first-day.md", "0.05 mag<!-- given: ", "0.05 mag<!-- given: x/", "has no 0.05 mag"),
        ("docs/first-day.md", "::UNSURE_MAG", "", "without a word of its line"),
        ("docs/first-day.md", "::UNSURE_MAG", "::MIN_READINGS", "has no 0.05 mag beside"),
        ("claims.toml", TEST, "tests/authority/test_nothing.py", "does not exist"),
        ("claims.toml", "test_every_star_is", "test_every_star_was", "does not exist"),
        ("claims.toml", '["apply_space_motion"]', '["starpm"]', "does not use starpm"),
        ("claims.toml", 'package = "astropy"', 'package = "galsim"', "does not import galsim"),
        ("claims.toml", 'oracle = "library"', 'oracle = "hope"', "the oracle is of no known kind"),
        ("claims.toml", 'value = "0.007"', 'value = "0.07"', "under half of 0.07 mas"),
        ("claims.toml", 'value = "0.007"', 'value = "0.005"', "out of"),
        ("claims.toml", "margin = 0.05", "margin = 0.3", "the margin is over 0.05"),
        ("claims.toml", "the catalogue; no code", "nothing", "hilstar imports astropy too"),
        ("claims.toml", 'name = "limits"', 'name = "limit"', "no row of the table limits"),
        ("claims.toml", '"FRAME_ARCSEC"', '"SPIN_ARCSEC"', "does not use SPIN_ARCSEC"),
        (TEST, CALL, "assert error_mas.max() < 1.0", "does not hand a value to holds"),
        (TEST, CALL, f"{CALL}\n    assert error_mas.max() < 1.0", "has a bound of its own"),
        (TEST, CALL, 'holds("star-places", 0.005)', "hands a constant to holds"),
        (TEST, ".apply_space_motion(", ".moved(", "does not use apply_space_motion"),
    ],
)
def test_what_is_falsified_is_found(falsified, name, before, after, fault):
    found = faults(falsified(name, before, after))
    assert any(fault in one for one in found), found


def other_digit(words: str, rng: np.random.Generator) -> str:
    """A number with another last digit of its mantissa."""
    mantissa, exponent, power = words.partition("e")
    other = (int(mantissa[-1]) + rng.integers(1, 10)) % 10
    return f"{mantissa[:-1]}{other}{exponent}{power}"


def test_any_marked_figure_that_is_changed_is_found(rng):
    """Each mark of each page in turn, by another digit of the number before it."""
    claims, pages = tool.claims_of(), tool.pages_of()
    known = {claim.id: claim for claim in claims}
    for name, text in pages.items():
        for mark in tool.MARK.finditer(text):
            ends = known[mark[1]].value.rpartition(" to ")
            at = text.rindex(ends[2], 0, mark.start())
            changed = text[:at] + other_digit(ends[2], rng) + text[at + len(ends[2]) :]
            found = support.faults_of_marks(claims, {name: changed})
            assert any(mark[1] in one for one in found if name in one), (name, mark[1])


def test_any_bound_that_is_loosened_is_found():
    """Each row in turn, with a figure of twice the size, or a margin of its size."""
    pages = tool.pages_of()
    for claim in tool.claims_of():
        ends = [2 * float(words.replace(" ", "")) for words in claim.value.split(" to ")]
        twice = dataclasses.replace(claim, value=" to ".join(f"{end:g}" for end in ends))
        assert any("the page has" in one for one in support.faults_of_marks([twice], pages))
        assert support.faults_of_row(dataclasses.replace(claim, margin=1.0)), claim.id


def test_too_few_oracles_outside_are_found(falsified):
    text = (ROOT / "claims.toml").read_text()
    inside = text.replace('oracle = "closed form"', 'oracle = "own derivation"')
    found = faults(falsified("claims.toml", text, inside))
    assert any("figures have an outside oracle" in one for one in found)


def test_a_measured_value_has_to_leave_the_figure_true(monkeypatch):
    monkeypatch.delenv(support.RECORDS, raising=False)  # what is planted here was not measured
    low, high = rows()[ROW].bound()
    holds(ROW, high)
    with pytest.raises(
        AssertionError, match=r"star-places: measured 0\.008; the pages say at most"
    ):
        holds(ROW, 0.008)
    assert low == float("-inf")
    about = rows()["codes-round-light"]
    assert about.bound() == pytest.approx((0.0935, 0.0945))
    with pytest.raises(AssertionError):
        holds(about.id, 0.093)
    with pytest.raises(AssertionError):
        holds(ROW, float("nan"))


def test_values_of_a_run_become_the_last_ones(tmp_path, monkeypatch):
    records = tmp_path / "records.jsonl"
    monkeypatch.setenv(support.RECORDS, str(records))
    for value in (0.0061, 0.0064, 0.0012):
        holds(ROW, value)
    monkeypatch.delenv(support.RECORDS)
    lines = [json.loads(line) for line in records.read_text().splitlines()]
    today = datetime.date(2031, 2, 3)
    before = (ROOT / "claims.toml").read_text()
    after = tool.renewed(before, lines, today)
    (tmp_path / "claims.toml").write_text(after)
    changed = [one for one in tool.claims_of(tmp_path) if one != rows()[one.id]]
    assert [one.id for one in changed] == [ROW]
    assert (changed[0].last, changed[0].date) == (0.0064, today)
    assert changed[0].version == lines[0]["version"] != ""


def test_a_run_that_measures_less_or_nothing_is_found():
    """As a test whose value is divided by ten would, which is within any upper limit."""
    row = rows()[ROW]
    whole = [{"claim": ROW, "value": str(row.last), "version": ""}]
    tenth = [{"claim": ROW, "value": str(float(row.last) / 10), "version": ""}]
    assert tool.strayed([row], whole) == []
    assert tool.strayed([row], tenth) == [f"{ROW}: 0.000663, and 0.00663 before"]
    assert tool.strayed([row], []) == [f"{ROW}: {row.test} did not measure it"]
