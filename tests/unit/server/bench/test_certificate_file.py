"""A bench's certificate: how far off it says that the bench may be, and when it is not this bench's
or is over.
"""

from __future__ import annotations

import datetime
import logging
from pathlib import Path
from typing import Any

import msgspec
import pytest

from hilstar.basics.errors import InputError
from hilstar.server.bench.bench_file import BenchFile, bench_file_of
from hilstar.server.bench.certificate_file import (
    KIND,
    Certificate,
    CertifiedFigure,
    CubeToBoresight,
    bench_certificate,
    certificate_number,
    off_by,
    read_certificate,
)
from tests.support.benches import bench_text


def figure(quantity: str, lower: float, upper: float) -> CertifiedFigure:
    """A figure with its interval."""
    return CertifiedFigure(
        quantity=quantity,
        region="screen",
        star=None,
        field=None,
        value=(lower + upper) / 2,
        standard_uncertainty=(upper - lower) / 4,
        k=2.0,
        lower=lower,
        upper=upper,
        unit="arcsec",
        dof=None,
        limit=None,
        conforms=None,
        truth=None,
        by_trials=None,
        contributions=[],
    )


FIGURES = [
    figure("attitude_x", -7.5, 3.0),  # its lower end is the farther one
    figure("attitude_y", -1.0, 6.0),
    figure("attitude_z", -2.0, 31.25),
    figure("flux", -0.5, 0.25),
]


def certificate(**changes: Any) -> Certificate:
    """A certificate of the figures above."""
    known: dict[str, Any] = {
        "kind": KIND,
        "number": "HS-1",
        "made": "2026-03-01T10:00:00Z",
        "valid_until": "2027-03-01",
        "hilstar": "1",
        "bench": "bench.toml",
        "bench_sha256": "0" * 64,
        "files": {},
        "monitor": {},
        "collimator": {},
        "read_by": "",
        "who": "",
        "where": "",
        "ambient": "",
        "traceability": "",
        "instrument": {},
        "decision": "guard-band",
        "conforms": None,
        "trials": 0,
        "two_digits_stand": True,
        "inputs": [],
        "figures": FIGURES,
        "not_assessed": [],
        "measurands": {},
    }
    return Certificate(**(known | changes))


def test_the_attitude_is_off_by_the_farther_end_of_the_widest_of_its_axes() -> None:
    whole = certificate()
    assert whole.expanded(["flux"]) == 0.5
    assert whole.expanded(["attitude_y", "flux"]) == 6.0
    assert whole.expanded(["place"]) is None
    assert whole.attitude_arcsec == (7.5, 31.25)
    assert "at most 7.5 arcsec across and 31.2 about the boresight (95 %)" in off_by(whole)
    assert whole.line == "certificate HS-1 of 2026-03-01, valid until 2027-03-01"


@pytest.mark.parametrize(
    ("latencies", "late_ms"),
    [
        ([(14.0, 17.0)], 2.0),
        ([(11.0, 16.0)], 4.0),
        ([(12.0, 13.0)], 3.0),  # the whole interval is before what is stated
        ([(15.5, 16.0), (14.5, 15.25), (13.0, 15.0)], 2.0),
        ([], None),
    ],
)
def test_light_is_late_or_early_by_the_farther_end_from_what_is_stated(latencies, late_ms) -> None:
    """Stated: 15 ms."""
    figures = [figure("latency", *ends) for ends in latencies]
    assert certificate(figures=[*FIGURES, *figures]).late_ms(15.0) == late_ms


@pytest.mark.parametrize("without", ["attitude_z", "attitude_x"])
def test_an_attitude_of_which_an_axis_was_not_assessed(without: str) -> None:
    """Of the two across the boresight one stands for both."""
    part = certificate(figures=[known for known in FIGURES if known.quantity != without])
    if without == "attitude_z":
        assert part.attitude_arcsec is None
        assert off_by(part) == "its own attitude was not assessed"
    else:
        assert part.attitude_arcsec == (6.0, 31.25)


def certified(folder: Path, number: str, **changes: Any) -> BenchFile:
    """A bench file that names a certificate of that number, of itself unless it is changed."""
    text = bench_text({"certify": {"certificate": "certificate.json"}})
    file = bench_file_of(folder / "bench.toml", text)
    made = certificate(**({"number": number, "bench_sha256": file.sha256} | changes))
    (folder / "certificate.json").write_bytes(msgspec.json.encode(made))
    return file


LAST_DAY = datetime.date(2027, 3, 1)


@pytest.mark.parametrize(
    ("number", "day", "changes", "words"),
    [
        ("HS-2", LAST_DAY, {}, []),
        ("HS-3", LAST_DAY + datetime.timedelta(days=1), {}, ["HS-3", "is over"]),
        ("HS-4", LAST_DAY, {"bench_sha256": "1" * 64}, ["HS-4", "another state of this bench"]),
    ],
)
def test_a_certificate_is_this_bench_s_until_the_end_of_its_last_day(
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    number: str,
    day: datetime.date,
    changes: dict[str, Any],
    words: list[str],
) -> None:
    file = certified(tmp_path, number, **changes)
    with caplog.at_level(logging.WARNING):
        found = bench_certificate(file, day)
    assert found is not None and found.number == number
    assert len(caplog.records) == bool(words)
    assert all(word in caplog.text for word in words)


def test_a_run_s_ledger_has_the_number_of_its_bench_s_certificate(tmp_path: Path) -> None:
    assert certificate_number(certified(tmp_path, "HS-5", valid_until="2999-01-01")) == "HS-5"
    assert certificate_number(bench_file_of(tmp_path / "plain.toml", bench_text())) == ""


@pytest.mark.parametrize(
    ("data", "words"), [(b"{}", "is no certificate"), (None, "'hilstar certificate 0' and")]
)
def test_what_is_no_certificate_is_refused(tmp_path: Path, data: bytes | None, words: str) -> None:
    path = tmp_path / "certificate.json"
    older = msgspec.json.encode(certificate(kind="hilstar certificate 0"))
    path.write_bytes(older if data is None else data)
    with pytest.raises(InputError, match=words):
        read_certificate(path)


@pytest.mark.parametrize(
    ("cross_arcsec", "roll_arcsec", "without", "told"),
    [
        (1.234, 56.78, (), "within 1.23 arcsec across and 56.8 about it (95 %)"),
        (None, 56.78, ("cube",), "its uncertainty is not known; without cube"),
        (1.234, None, ("a", "b"), "its uncertainty is not known; without a, b"),
    ],
)
def test_a_boresight_is_told_with_how_sure_it_is_across_and_about_it(
    cross_arcsec, roll_arcsec, without, told
):
    boresight = CubeToBoresight(
        reference="the cube",
        boresight=(0.001, -0.002, 0.9999975),
        q_tracker_to_reference=(1.0, 0.0, 0.0, 0.0),
        cross_arcsec=cross_arcsec,
        roll_arcsec=roll_arcsec,
        without=without,
    )
    assert boresight.line == f"x +0.0010000, y -0.0020000, z +0.9999975 of the cube, {told}"
