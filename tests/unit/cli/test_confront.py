"""hilstar confront from its words to what it hands on, and from what is found to what is said."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.cli import confront as command
from hilstar.cli.pointing import PointingOptions, attitude_of
from hilstar.instruments.confront import run
from hilstar.instruments.confront.report import Confronted
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.planted_sky import write_bench

BARNARD = "87937"  # moves by 10 arcsec a year
EPOCH_JYEAR = 1990.0
TAKEN_NS = round(datetime.datetime(2020, 1, 2, 3, 4, 5, tzinfo=datetime.UTC).timestamp()) * 10**9


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_bench(tmp_path / "bench.toml", more=f"[sky]\nepoch_jyear = {EPOCH_JYEAR}\n")
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes(b"")
    return tmp_path


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What each confrontation was asked for; it ends there."""
    every: list[dict[str, Any]] = []

    def confront(bench: Path, images: Any, output: Path, **asked_for: Any) -> Any:
        every.append(asked_for | {"images": [path.name for path in images], "output": output})
        raise InputError("enough")

    monkeypatch.setattr(run, "confront", confront)
    return every


def confronted(folder: Path, *words: str) -> Any:
    return run_hilstar_here("confront", "bench.toml", *words, "-o", "out", cwd=folder)


def test_images_are_confronted_at_the_bench_s_epoch_and_at_the_time_that_is_stated(folder, asked):
    words = ("--star", BARNARD, "--taken", "2020-01-02T03:04:05", "--fixed")
    assert_refused(confronted(folder, "a.png", "b.png", *words), 2, "enough")
    assert_refused(confronted(folder, "b.png"), 2, "enough")
    stated, bare = asked
    start = attitude_of("confront", PointingOptions(star=BARNARD), EPOCH_JYEAR)
    assert np.array_equal(stated["start"], start)
    assert (stated["at_ns"], stated["fixed"]) == (TAKEN_NS, True)
    assert (stated["images"], stated["output"]) == (["a.png", "b.png"], Path("out"))
    assert (bare["start"], bare["at_ns"], bare["fixed"]) == (None, None, False)
    assert bare["images"] == ["b.png"]


def test_photographs_are_taken_into_a_folder_of_their_own(folder, asked, monkeypatch):
    taken = []

    def photographs(file: Any, *given: Any) -> list[Path]:
        taken.append(given)
        return [folder / "c.png"]

    monkeypatch.setattr(command, "photographs", photographs)
    grab = ("--grab", "cp c {output}")
    confronted(folder, *grab)
    confronted(folder, *grab, "--count", "2", "--exposure", "0.25")
    images = Path("out/images")
    assert taken == [(grab[1], 5, None, images), (grab[1], 2, 0.25, images)]
    assert [each["images"] for each in asked] == [["c.png"], ["c.png"]]


@pytest.mark.parametrize("flag", ["--count", "--exposure"])
def test_what_is_of_photographs_to_be_taken_is_refused_without_them(folder, asked, flag):
    refused = confronted(folder, "a.png", flag, "3")
    assert_refused(refused, 2, f"{flag}: is for --grab; write --grab, or leave it out")
    assert not asked


class Told(Confronted):
    """A confrontation without its session, whose figures are not what is tested."""

    @property
    def figures(self) -> dict[str, Any]:
        return {"images": []}


@pytest.mark.parametrize(
    ("failures", "strict", "code"), [((), True, 0), (("off",), False, 0), (("off",), True, 1)]
)
def test_notes_and_failures_are_said_and_strict_fails_by_failures_alone(
    folder, monkeypatch, failures, strict, code
):
    told = Told(None, (), None, ("focal length 18 mm",), failures, ("a note",), (), (0, 0))  # type: ignore[arg-type]
    monkeypatch.setattr(run, "confront", lambda *_, **__: told)
    done = confronted(folder, "a.png", *(["--strict"] * strict))
    assert done.returncode == code
    assert done.stdout.splitlines() == ["focal length 18 mm", "page: out/index.html"]
    assert done.stderr.splitlines() == ["a note", *failures]
