"""--radec in degrees and sexagesimal, and --star."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from astropy.coordinates import SkyCoord

from hilstar.basics.errors import InputError
from hilstar.basics.resources import resource_path
from hilstar.cli.app import built
from hilstar.cli.options import LogStatements
from hilstar.cli.pointing import (
    USUAL_EPOCH_JYEAR,
    PlaceOptions,
    PointingOptions,
    attitude_of,
    parse_radec,
    parse_star,
    place_of,
)
from hilstar.cli.send import SendOptions, wanted_samples
from hilstar.server.bench.config.sky import SkySettings
from tests.support.benches import ROOT
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.senders import free_port

DEMO = str(resource_path("configs", "demo.toml"))
SMALL = str(ROOT / "examples" / "bench.toml")
ROUNDING_DEG = 1e-12


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("5h36m13.68s,-1d12m0s,12.5", "5h36m13.68s -1d12m0s"),
        ("05:36:13.68,-01:12:00,12.5", "5h36m13.68s -1d12m0s"),
        ("5 36 13.68, -1 12 0, 12.5", "5h36m13.68s -1d12m0s"),
        ("84.057d,-1.2d,12.5", "84.057d -1.2d"),
        ("84d3m25.2s,-0:12:0,12.5", "84d3m25.2s -0d12m0s"),
        ("23h59m59s,-1.2,12.5", "23h59m59s -1d12m0s"),
    ],
)
def test_sexagesimal_is_read_as_astropy_reads_it(text, place):
    wanted = SkyCoord(place)
    assert parse_radec(text) == pytest.approx(
        (wanted.ra.deg, wanted.dec.deg, 12.5), abs=ROUNDING_DEG
    )


@pytest.mark.parametrize("place", [(84.057, -1.2, 0.0), (10.0, 90.0, -5.0), (370.0, -90.0, 400.0)])
def test_numbers_are_degrees_from_pole_to_pole(place):
    assert parse_radec(",".join(map(str, place))) == place


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("5h61m0s,1d0m,0", "sexagesimal: 5h36m14s"),
        ("5h60m0s,1d0m,0", "sexagesimal: 5h36m14s"),
        ("5h36m,-91d0m,0", "a declination from -90 to 90"),
        ("10,90.0001,0", "a declination from -90 to 90"),
        ("5h36m,-1d12m,north", "sexagesimal: 5h36m14s"),
        ("5h36m,-1d12m", "write RA,DEC,ROLL in degrees"),
        ("Orion,-1d12m,0", "write RA,DEC,ROLL in degrees"),
        ("nan,1d,0", "write RA,DEC,ROLL in degrees"),
        ("-1d12m,5h36m14s,0", "write RA,DEC,ROLL in degrees"),
    ],
)
def test_a_place_that_is_none_is_refused(text, said):
    with pytest.raises(InputError, match=said):
        parse_radec(text)


def test_a_star_is_in_the_middle_of_its_frame(tmp_path):
    for turned in ("", ",30"):
        words = ["frame", SMALL, "--star", f"alpha Lyr{turned}", "--truth", "t.csv"]
        done = run_hilstar_here(*words, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        header, *rows = (tmp_path / "t.csv").read_text().splitlines()
        columns = header.split(",")
        vega = next(
            row
            for row in (dict(zip(columns, row.split(","), strict=True)) for row in rows)
            if row["hip"] == "91262"
        )
        width, height = tomllib.loads(Path(SMALL).read_text())["monitor"]["resolution_px"]
        assert float(vega["x_px"]) == pytest.approx((width - 1) / 2, abs=1e-3)
        assert float(vega["y_px"]) == pytest.approx((height - 1) / 2, abs=1e-3)


def test_star_and_radec_of_its_place_are_one_attitude():
    ra_deg, dec_deg, roll_deg = parse_star("Vega,30", 2026.0)
    assert roll_deg == 30
    by_star = attitude_of("frame", PointingOptions(star="Vega,30"), 2026.0)
    place = PointingOptions(radec=f"{ra_deg!r},{dec_deg!r},30")
    by_place = attitude_of("frame", place)
    assert np.array_equal(by_star, by_place)


def test_a_spin_begins_at_the_star():
    place = place_of("send", PlaceOptions(star="Vega"))
    sent = wanted_samples(SendOptions(spin="z,1"), place, LogStatements())
    begun = next(iter(sent.samples)).q_icrs_to_cam
    assert np.array_equal(begun, attitude_of("send", PointingOptions(star="Vega")))


def test_a_log_has_attitudes_of_its_own(tmp_path):
    words = ["send", str(ROOT / "examples" / "slew.csv"), "--to", f"udp://127.0.0.1:{free_port()}"]
    words += ["--star", "Vega", "--wait", "0", "--count", "1"]
    done = run_hilstar_here(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "--star say where a --spin begins" in done.stderr


def test_the_epoch_without_a_bench_is_that_of_one_that_states_none():
    assert SkySettings().epoch_jyear == USUAL_EPOCH_JYEAR


def test_star_stands_wherever_radec_does():
    for name, command in built(None).commands.items():
        for inner in getattr(command, "commands", {name: command}).values():
            options = {word for parameter in inner.params for word in parameter.opts}
            assert ("--radec" in options) == ("--star" in options), name


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--star", "Vega", "--radec", "1,2,3"], "one of --radec RA,DEC,ROLL, --star NAME"),
        (["--radec", "vega"], "--radec vega: is a star; write --star vega"),
        (["--radec", "alpha Lyr"], "is a star; write --star 'alpha Lyr'"),
        (["--star", "Vga"], "--star Vga: no star has this name; did you mean Vega?"),
        (["--star", "Vega,up"], "write NAME,ROLL in degrees, such as Vega,30"),
        (["--radec", "5h36m14s", "-1d12m", "0"], "write --radec 5h36m14s,-1d12m,0"),
    ],
)
def test_what_points_nowhere_is_refused(words, said, tmp_path):
    refused = run_hilstar_here("frame", DEMO, *words, "-o", "o.fits", cwd=tmp_path)
    assert_refused(refused, 2, said)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["budget", DEMO, "--star", "Vega"], "budget --star: names a field of stars"),
        (["study", "faults", "--star", "Vega", "-o", "d"], "study faults: has fields of its own"),
        (["study", "models", "--star", "Vega", "-o", "d"], "BENCH.toml --star Vega"),
        (["send", "--star", "Vega"], "add --spin AXIS,DEG_PER_S, such as --spin z,0"),
        (["send"], "send: give either a LOG or --spin AXIS,DEG_PER_S"),
        (["send", "--spin", "z,1", "--star", "Vga"], "did you mean Vega?"),
        (["send", "--spin", "z,1", "--star", "Vega", "--radec", "1,2,3"], "leave one out"),
    ],
)
def test_other_commands_refuse_what_they_do_not_use(words, said, tmp_path):
    assert_refused(run_hilstar_here(*words, cwd=tmp_path), 2, said)
