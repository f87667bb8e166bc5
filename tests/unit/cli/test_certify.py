"""hilstar certify from its words to its files: what is kept, replaced and said, where the readings
and the budget are the test's.
"""

from __future__ import annotations

import datetime
import hashlib
import json
import math
from pathlib import Path
from typing import Any

import msgspec
import pytest

from hilstar.instruments.calibrate.warm_up import WarmUp
from hilstar.instruments.certify import certificate as certificates
from hilstar.instruments.certify import check as checks
from hilstar.instruments.certify import readings
from hilstar.instruments.certify.check import CheckFigure
from hilstar.instruments.certify.readings import ImageReader, VirtualReader
from tests.support.benches import bench_text
from tests.support.commands import run_hilstar_here
from tests.unit.server.bench.test_certificate_file import certificate

pytestmark = pytest.mark.usefixtures("without_charts")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a bench and what it truly is."""
    for name in ("bench.toml", "truth.toml"):
        (tmp_path / name).write_text(bench_text())
    return tmp_path


def certify(folder: Path, *words: str, virtual: bool = False) -> Any:
    """The command's end; with the truth where it is `virtual`."""
    truth = ["--virtual", "truth.toml"] if virtual else []
    return run_hilstar_here("certify", "bench.toml", "-o", "out", *truth, *words, cwd=folder)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What each certificate was asked for; they are numbered from 1."""
    made: list[dict[str, Any]] = []

    def certified(file: Any, reader: Any, now: Any, **asked_for: Any) -> Any:
        made.append(asked_for | {"reader": reader})
        reference = None if reader is None else f"reference {len(made)}".encode()
        return certificate(number=f"HS-{len(made)}", replaces=asked_for["replaces"]), reference

    monkeypatch.setattr(certificates, "certify", certified)
    return made


class Source:
    """A source of images, which tells what it was asked before it has taken one."""

    identity, monitor = "a camera, serial 7", None

    def __init__(self) -> None:
        self.asked: list[Any] = []

    def find_monitor(self, file: Any, today: datetime.date, *, force: bool) -> None:
        self.asked.append(
            (file.path.name, (datetime.datetime.now(datetime.UTC).date() - today).days, force)
        )

    def gate(self, file: Any) -> None:
        self.asked.append("gate")

    def close(self) -> None:
        self.asked.append("closed")


@pytest.mark.parametrize("again", [False, True])
def test_images_of_a_camera_are_read_past_the_gate_of_the_monitor_that_is_there(
    folder: Path, asked: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, again: bool
) -> None:
    source = Source()
    monkeypatch.setattr("hilstar.cli.certify.image_source", lambda file, images: source)
    done = certify(folder, "--grab", "take {output}", *["--again"] * again)
    assert done.returncode == 0, done.stderr
    reader = asked[0]["reader"]
    assert isinstance(reader, ImageReader) and reader.source is source
    assert reader.truth is None and not reader.folder.exists()
    (monitor, *rest) = source.asked
    assert monitor in {("bench.toml", days, again) for days in (0, 1)}  # around midnight
    assert rest == ["gate", "closed"]
    assert "images by a camera, serial 7" in done.stderr


def test_a_certificate_is_kept_with_its_page_and_said_with_the_digest_of_its_file(
    folder: Path, asked: list[dict[str, Any]]
) -> None:
    done = certify(folder, "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    raw = (folder / "out" / "certificate.json").read_bytes()
    assert told["sha256"] == hashlib.sha256(raw).hexdigest()
    assert (told["number"], told["page"]) == ("HS-1", "out/index.html")
    assert json.loads(raw)["number"] == "HS-1"
    assert told["sha256"][:16] in (folder / "out" / "index.html").read_text()
    # nothing was read, so that a check has nothing to refer to
    assert sorted(path.name for path in (folder / "out").iterdir()) == [
        "certificate.json", "index.html",
    ]  # fmt: skip
    assert asked[0]["reader"] is None and asked[0]["warm_up"] is None
    assert not asked[0]["quick"]


def test_a_certificate_is_replaced_by_again_alone_and_names_the_one_before(
    folder: Path, asked: list[dict[str, Any]]
) -> None:
    assert certify(folder, "--quick").returncode == 0
    refused = certify(folder)
    assert refused.returncode == 2
    assert "out/certificate.json: exists; write --again" in refused.stderr
    again = certify(folder, "--again", "--json", virtual=True)
    assert json.loads(again.stdout)["replaces"] == "HS-1"
    assert [each["replaces"] for each in asked] == [None, "HS-1"]
    assert [each["quick"] for each in asked] == [True, False]
    assert isinstance(asked[1]["reader"], VirtualReader)
    assert (folder / "out" / "reference.json").read_bytes() == b"reference 2"


@pytest.mark.parametrize(("law", "counts"), [("exponential", True), ("none", False)])
def test_a_warm_up_that_follows_a_law_counts_in_the_certificate(
    folder: Path,
    asked: list[dict[str, Any]],
    monkeypatch: pytest.MonkeyPatch,
    law: str,
    counts: bool,
) -> None:
    watched: list[tuple[int, float]] = []
    warm_up = WarmUp(law, True, 0.002, ahead=-0.001, ahead_error=0.0005, dof=30)

    def watch(reader: Any, white: int, longest_min: float, path: Path) -> WarmUp:
        watched.append((white, longest_min))
        return warm_up

    monkeypatch.setattr(checks, "watch", watch)
    done = certify(folder, "--warm-up", "12", virtual=True)
    assert done.returncode == 0 and warm_up.line in done.stderr
    assert watched == [(255, 12.0)]
    assert asked[0]["warm_up"] == (warm_up.bound if counts else None)


def figure(quantity: str, value: float, is_within: bool) -> CheckFigure:
    """A figure of a check, known to half of it."""
    return CheckFigure(
        quantity, value, value / 4, value / 2, 1.5 * value, "arcsec", math.inf, 2.0, 1.75, is_within
    )


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[CheckFigure]:
    """The figures of each check, which may be changed; and that a check was compared with."""
    found = [figure("shift", 1.5, True), figure("focus", 0.25, True)]
    monkeypatch.setattr(checks, "take_check", lambda file, reader: "readings of now")
    monkeypatch.setattr(checks, "by_bench_file", lambda file: "the file's")
    monkeypatch.setattr(checks, "draw_checks", lambda path, rows: None)

    def compare(file: Any, was: Any, now: Any) -> list[CheckFigure]:
        assert (was, now) == ("the file's", "readings of now")
        return list(found)

    monkeypatch.setattr(checks, "compare", compare)
    return found


def test_a_check_says_whether_the_bench_has_moved_and_since_when(
    folder: Path, figures: list[CheckFigure]
) -> None:
    well = certify(folder, "--check", virtual=True)
    assert well.returncode == 0
    assert "has no certificate; the check is against the bench file" in well.stderr
    lines = [line.split() for line in well.stdout.splitlines()]
    assert ["shift", "+1.5", "+-", "0.75", "arcsec", "in", "tolerance", "(1.8)"] in lines
    assert ["since", "the", "bench", "file"] in lines
    assert lines[-1] == ["verdict", "the", "bench", "is", "as", "certified"]
    figures[1] = figure("focus", -0.75, False)
    (folder / "out" / "certificate.json").write_bytes(msgspec.json.encode(certificate()))
    moved = certify(folder, "--check", virtual=True)
    assert moved.returncode == 1
    assert "focus           -0.75 +- -0.38 arcsec       OUT OF tolerance (1.8)" in moved.stdout
    assert "since           HS-1" in moved.stdout
    assert "verdict         the bench has moved: certify it --again" in moved.stdout


def test_checks_are_counted_and_each_draws_other_figures(
    folder: Path, figures: list[CheckFigure], monkeypatch: pytest.MonkeyPatch
) -> None:
    counts, turns = [], []
    monkeypatch.setattr(readings, "VirtualReader", lambda *given: turns.append(given[-1]) or given)
    for _ in range(2):
        told = json.loads(certify(folder, "--check", "--json", virtual=True).stdout)
        assert told["in_tolerance"] is True and told["warm_up"] is None
        assert [each["quantity"] for each in told["figures"]] == ["shift", "focus"]
        counts.append(told["checks"])
    assert counts == [1, 2] and 0 < turns[0] < turns[1]  # the certificate's own are 0
    figures[0] = figure("shift", 9.0, False)
    third = certify(folder, "--check", "--json", virtual=True)
    assert third.returncode == 1
    told = json.loads(third.stdout)
    assert (told["in_tolerance"], told["checks"], told["certificate"]) == (
        False,
        3,
        "the bench file",
    )


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--check"], "--check: reads the bench; write --grab CMD, or --virtual TRUTH.toml"),
        (["--warm-up", "3"], "write --grab CMD, or --virtual TRUTH.toml"),
        (["--whole"], "--whole: is for --virtual; leave it out"),
        (["--virtual", "truth.toml", "--grab", "true"], "--grab: a virtual bench has its own"),
        (["--virtual", "truth.toml", "--diode", "serial:/dev/x@9600"], "--diode: a virtual bench"),
        (["--virtual", "truth.toml", "--feed", "tcp://127.0.0.1:1"], "--feed: a virtual bench"),
    ],
)
def test_options_of_the_other_kind_of_bench_are_refused(
    folder: Path, words: list[str], line: str
) -> None:
    refused = certify(folder, *words)
    assert refused.returncode == 2 and line in refused.stderr
    assert not (folder / "out").exists()
