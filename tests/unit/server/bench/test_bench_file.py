"""One run has one bench: whatever becomes of the file once it has been read, the run keeps to
what it read.
"""

from __future__ import annotations

import sys
from dataclasses import FrozenInstanceError

import pytest

from hilstar.basics.errors import InputError
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.server.bench import build
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.build import open_bench
from hilstar.server.record.ledger import Ledger
from hilstar.server.record.ledger_records import config_of, read_head
from tests.support.benches import SMALL_BENCH
from tests.support.commands import run_hilstar_here

OTHER_BENCH = SMALL_BENCH.replace("[320, 240]", "[160, 120]")
FAINT = """\
[sky]
faintest_v_mag = 9
[render]
quantisation = "round"  # with white as Sirius most stars are under a step
brightest_v_mag = -1
"""
opened: list[str] = []
sys.addaudithook(
    lambda event, told: (
        opened.append(str(told[0]))
        if event == "open" and str(told[0]).endswith("bench.toml")
        else None
    )
)


def test_a_bench_that_cannot_be_opened_lets_its_own_context_go(tmp_path, monkeypatch):
    """A window frees its own; where NumPy draws there is none."""
    path = tmp_path / "bench.toml"
    path.write_text(SMALL_BENCH.replace("[collimator]", 'calibration = "none.toml"\n[collimator]'))
    file = read_bench_file(path)
    released = []

    class OwnContext:
        def release(self) -> None:
            released.append(self)

    own, windows = OwnContext(), OwnContext()
    for made, given, freed in ((own, None, [own]), (None, None, []), (own, windows, [])):
        released.clear()
        monkeypatch.setattr(build, "headless_context", lambda gpu, made=made: made)
        with pytest.raises(InputError, match=r"none\.toml"):
            open_bench(file, given)
        assert released == freed


def test_a_file_that_is_replaced_after_it_was_read_changes_nothing_of_the_run(
    small_bench_file, tmp_path
):
    file = read_bench_file(small_bench_file)
    small_bench_file.write_text(OTHER_BENCH)
    with open_bench(file) as bench, Ledger(tmp_path / "run.mcap", bench):
        assert bench.renderer.target.resolution_px == bench.camera.resolution_px == (320, 240)
    head = read_head(tmp_path / "run.mcap")
    assert head["bench_text"] == SMALL_BENCH
    assert head["bench_sha256"] == file.sha256 != read_bench_file(small_bench_file).sha256
    config = config_of(head)
    assert config is not None and config.monitor.resolution_px == (320, 240)


@pytest.mark.e2e
@pytest.mark.parametrize("command", ["serve", "replay", "frame"])
def test_a_command_opens_the_bench_file_once(small_bench_file, tmp_path, command):
    log = tmp_path / "log.csv"
    log.write_text("t_s,qw,qx,qy,qz\n0,1,0,0,0\n0.1,1,0,0,0\n")
    options = {
        "serve": ["--headless", "--frames", "3", "--ledger", tmp_path / "run.mcap"],
        "replay": [log, "--headless", "--speed", "max", "--ledger", tmp_path / "run.mcap"],
        "frame": ["--radec", "84,0,0", "-o", tmp_path / "out.fits"],
    }[command]
    if command == "serve":
        small_bench_file.write_text(SMALL_BENCH + '[attitude]\nendpoint = "tcp://127.0.0.1:9"\n')
    opened.clear()
    done = run_hilstar_here(command, small_bench_file, *options)
    assert done.returncode in {0, 4}, done.stderr  # 4: nobody sent an attitude
    assert opened.count(str(small_bench_file)) == 1


def test_nothing_of_a_bench_can_be_assigned(bench_with):
    bench = bench_with()
    for name in ("stars", "shown_stars", "config", "renderer", "flux_at_white_e_per_s"):
        with pytest.raises(FrozenInstanceError):
            setattr(bench, name, None)


def test_a_bench_with_other_stars_shows_all_of_them_and_is_otherwise_the_same(bench_with):
    bench = bench_with(FAINT)
    other = bench.with_stars(bench.faint_stars)
    assert len(bench.faint_stars) > 0
    assert other.shown_stars is other.stars is bench.faint_stars
    assert len(other.faint_stars) == 0 and other.renderer is bench.renderer


def test_the_stars_that_are_too_faint_are_those_of_the_sky_that_are_not_shown(bench_with):
    bench, q = bench_with(FAINT), from_radec_roll_deg(84, -1, 0)
    too_faint = len(bench.sprites(q, bench.stars)) - len(bench.sprites(q))
    assert bench.count_faint(q) == too_faint > 10
