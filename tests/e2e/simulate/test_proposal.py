"""What `hilstar verify` proposes for a bench that fails, and what it writes into the bench file."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest

from hilstar.display.response import srgb_response
from tests.support.benches import TWIN, bench_text
from tests.support.commands import assert_refused, run_hilstar_here

FIELDS = "2"
# Measured: `round` 0.012 mag off at 95 %, `exact` 0.002.
LIMIT = "[verify]\nflux_mag = 0.006\n"
ROUNDED = {"monitor": {"bits": 8}, "render": {"quantisation": "round"}}
TRUE_LENS = """\
kind = "hilstar geometry 1"
resolution_px = [640, 480]
focal_length_px = 2081.5
principal_point_px = [319.3, 240.5]
q_cam_to_mon = [1.0, 0.0, 0.0, 0.0]
tilt_deg = [0.3, 0.2]
k1 = 0.3
"""
NO_WEIGHTS = """\
[calibration]
kind = "photometric"
who = "a test"
when = "2026-11-21"
instrument = "none"
unit = "relative"
bits = 8
response = "monitor.csv"
"""


def write_bench(folder: Path, *changes: dict, more: str = LIMIT) -> Path:
    path = folder / "bench.toml"
    path.write_text("# ours\n" + bench_text(TWIN, ROUNDED, *changes) + more)
    return path


def measured_monitor(folder: Path) -> dict:
    """Changes to a monitor that was measured, as sRGB and without weights, and to a scale that
    was measured too.
    """
    rows = "\n".join(
        f"{code},{light!r}" for code, light in enumerate(srgb_response(8).light.tolist())
    )
    (folder / "monitor.csv").write_text(f"code,w\n{rows}\n")
    (folder / "monitor.toml").write_text(NO_WEIGHTS)
    render = {"flux_at_white_e_per_s": 1e8, "quantisation": "exact"}
    return {"monitor": {"calibration": "monitor.toml"}, "render": render}


def verified(path: Path, *options: str) -> tuple[int, dict]:
    result = run_hilstar_here("verify", path, "--fields", FIELDS, "--json", *options)
    assert result.stdout, result.stderr
    return result.returncode, json.loads(result.stdout)


def test_the_change_that_is_written_makes_the_bench_pass_and_keeps_the_rest(tmp_path):
    path = write_bench(tmp_path)
    before = path.read_text()
    _, plain = verified(path)
    assert not plain["passed"]
    assert "proposal" not in plain
    code, proposed = verified(path, "--propose", "--strict")
    assert (code, proposed["written"], path.read_text()) == (1, False, before)
    assert proposed["proposal"]["changes"] == [
        {"table": "render", "key": "quantisation", "value": "exact"}
    ]
    assert {key: proposed[key] for key in plain} == plain
    code, written = verified(path, "--write", "--strict")
    assert (code, written["written"]) == (0, True)
    assert path.read_text() == before.replace('"round"', '"exact"')
    code, now = verified(path, "--propose", "--strict")
    assert (code, now["passed"], now["proposal"], now["written"]) == (0, True, None, False)
    assert now["flux_error_mag"] == written["proposal"]["verified"]["flux_error_mag"]


def test_a_person_is_shown_the_difference(tmp_path):
    path = write_bench(tmp_path)
    result = run_hilstar_here("verify", path, "--fields", FIELDS, "--write")
    assert result.returncode == 0, result.stderr
    for line in (
        '-quantisation = "round"',
        '+quantisation = "exact"',
        f"written             {path}",
    ):
        assert line in result.stdout.splitlines()


def test_what_the_calibration_refuses_is_not_proposed(tmp_path):
    """A measured monitor without weights steals no bits, and a measured scale leaves no choice
    of full scale.
    """
    path = write_bench(
        tmp_path, measured_monitor(tmp_path), more="[verify]\nflux_mag = 1e-5\ncentroid_px = 1e-5\n"
    )
    _, summary = verified(path, "--propose")
    proposal = summary["proposal"]
    assert proposal["changes"] == []
    assert {change["key"] for change in proposal["best"]} == {"faintest_v_mag"}
    assert proposal["tried"] == 1
    assert "8 bits cannot show stars of V" in proposal["cannot"]
    assert not proposal["verified"]["passed"]


def test_the_smallest_change_of_a_magnitude_is_proposed(tmp_path):
    """`exact` is there already, and full scale is measured: fainter stars go, by no more than the
    limits ask for.

    Measured: 0.88 px off at 95 % to V = 6.5, 0.25 to V = 6.
    """
    path = write_bench(
        tmp_path,
        measured_monitor(tmp_path),
        {"sky": {"faintest_v_mag": 7.0}},
        more="[verify]\nflux_mag = 0.06\ncentroid_px = 0.4\n",
    )
    code, summary = verified(path, "--write", "--strict")
    (change,) = summary["proposal"]["changes"]
    assert (code, change["table"], change["key"]) == (0, "sky", "faintest_v_mag")
    milder = change["value"] + 0.5
    path.write_text(
        path.read_text().replace(
            f"faintest_v_mag = {change['value']}", f"faintest_v_mag = {milder}"
        )
    )
    assert not verified(path)[1]["passed"]


def test_a_bench_that_fails_for_its_geometry_gets_no_change_of_its_light(tmp_path):
    path = write_bench(
        tmp_path, {"render": {"quantisation": "exact"}}, more='[verify]\ntrue_mirror = "x"\n'
    )
    _, summary = verified(path, "--propose")
    proposal = summary["proposal"]
    assert (proposal["changes"], proposal["tried"]) == ([], 0)
    assert "mirrored" in proposal["cannot"]


def write_true_lens(folder: Path, assumed: dict | None) -> Path:
    """A bench that rounds, with a true lens, and with the lens that it assumes, by keys that
    differ from the true one.
    """
    (folder / "truth.toml").write_text(TRUE_LENS)
    changes = {}
    if assumed is not None:
        lines = [
            f"{key} = {value}"
            for key, value in (tomllib.loads(TRUE_LENS) | assumed).items()
            if key != "kind"
        ]
        (folder / "geometry.toml").write_text(
            "\n".join(['kind = "hilstar geometry 1"', *lines]) + "\n"
        )
        changes = {"collimator": {"geometry": "geometry.toml"}}
    return write_bench(folder, changes, more=LIMIT + 'true_geometry = "truth.toml"\n')


def test_behind_a_true_lens_that_the_bench_has_the_codes_are_mended(tmp_path):
    path = write_true_lens(tmp_path, {})
    code, summary = verified(path, "--write", "--strict")
    assert summary["proposal"]["changes"] == [
        {"table": "render", "key": "quantisation", "value": "exact"}
    ]
    assert (code, verified(path)[1]["passed"]) == (0, True)


@pytest.mark.parametrize(
    ("assumed", "words"),
    [
        ({"principal_point_px": [319.62, 240.5]}, "px off at 95 % without them"),
        ({"focal_length_px": 2050.0}, "stars"),
        (None, "px off at 95 % without them"),
    ],
)
def test_behind_another_true_lens_no_key_of_the_light_is_proposed(tmp_path, assumed, words):
    """0.12 px off at 95 % by 0.3 px of the screen, the codes 0.01; all stars lost; 1.5 px off by
    tilt and lens.
    """
    path = write_true_lens(tmp_path, assumed)
    before = path.read_text()
    code, summary = verified(path, "--write", "--strict")
    proposal = summary["proposal"]
    assert (code, proposal["changes"], proposal["best"], proposal["tried"]) == (1, [], [], 0)
    assert words in proposal["cannot"] and "bits cannot show" not in proposal["cannot"]
    assert path.read_text() == before


@pytest.mark.parametrize("mode", [0o444, 0o555])
def test_a_protected_bench_file_is_not_written(tmp_path, mode):
    path = write_bench(tmp_path)
    before = path.read_text()
    path.chmod(mode)
    assert_refused(run_hilstar_here("verify", path, "--fields", FIELDS, "--write"), 2, "read-only")
    assert path.read_text() == before


def test_a_key_that_cannot_be_set_in_this_form_of_toml_is_not_proposed(tmp_path):
    path = write_bench(tmp_path)
    tables = path.read_text().replace('[render]\nquantisation = "round"\n', "")
    path.write_text('render.quantisation = "round"\n' + tables)
    _, summary = verified(path, "--propose")
    assert not summary["passed"]
    assert "render" not in {change["table"] for change in summary["proposal"]["changes"]}
