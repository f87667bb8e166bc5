"""What exposures see of a screen that refreshes, against a simulation of it; and the rates
proposed instead.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.server.bench.config import parse_config
from hilstar.server.sync import ARCSEC_PER_DEG, Exposures, beat, beat_line, beat_of, seen_at
from tests.support.benches import bench_text
from tests.support.claims import holds
from tests.support.refusals import refusal

STEPS = 40_000  # of the simulated exposures: a row's edge falls within 1 of them, at both ends
CASES = {
    "6.3 refreshes": Exposures(60.0, 0.105),
    "less than one": Exposures(60.0, 0.004),
    "just under six": Exposures(59.94, 0.1),
    "lit a quarter": Exposures(60.0, 0.105, lit_s=1 / 240),
    "lit a quarter, six": Exposures(60.0, 0.1, lit_s=1 / 240),
    "flashes": Exposures(60.0, 0.04, lit_s=1e-4),
}


def simulated(exposures, phase):
    """Brute force: the light of the rows, and the middle of the frames seen, at STEPS moments of
    an exposure.
    """
    t = phase + (np.arange(STEPS) + 0.5) / STEPS * exposures.refreshes
    frame = np.floor(t)
    lit = t - frame < exposures.lit
    if not lit.any():
        return math.nan, 0.0
    off = (frame[lit] + exposures.lit / 2).mean() - (phase + exposures.refreshes / 2)
    return off / exposures.refresh_hz, lit.mean() / exposures.lit


@pytest.mark.parametrize("exposures", CASES.values(), ids=CASES)
def test_what_is_seen_is_what_a_simulated_row_shows(exposures, rng):
    phases = rng.uniform(0, 1, 60)
    found = seen_at(exposures, phases)
    wanted = np.array([simulated(exposures, phase) for phase in phases])
    # Each edge of a row's light within the exposure, and both ends of it, may be a step off.
    edges = 2 * math.ceil(exposures.refreshes) + 4
    assert np.abs(found.light - wanted[:, 1]).max() <= edges / STEPS / exposures.lit
    bright = wanted[:, 1] > 0.5
    assert bright.any()
    moved = edges / STEPS * exposures.refreshes / (exposures.lit * wanted[bright, 1].min())
    assert np.abs(found.off_s - wanted[:, 0])[bright].max() * exposures.refresh_hz <= moved


@pytest.mark.parametrize("frame_hz", [9.0, 9.3, 7.9])
def test_a_long_run_of_exposures_beats_with_the_period_and_by_the_amount_foretold(frame_hz):
    """4096 exposures one after another: the strongest line of the spectrum, and the extremes."""
    exposures = Exposures(60.0, 0.105, frame_hz)
    found = beat(exposures)
    off_s = seen_at(exposures, np.arange(4096) * 60.0 / frame_hz).off_s
    line_hz = np.argmax(np.abs(np.fft.rfft(off_s))[1:]) + 1
    assert 1 / found.period_s == pytest.approx(line_hz * frame_hz / 4096, abs=frame_hz / 4096)
    worst = np.abs(off_s).max() * ARCSEC_PER_DEG
    assert found.worst_arcsec_per_deg_s * 0.98 < worst <= found.worst_arcsec_per_deg_s * (1 + 1e-9)


@pytest.mark.parametrize("refreshes", [0.4, 1.5, 6.3, 30.7])
def test_of_rows_that_stay_lit_the_largest_error_is_a_closed_form(refreshes):
    """f (1 - f) / 2 of a refresh's path over n + f; and no light is lost."""
    part = refreshes % 1
    found = beat(Exposures(60.0, refreshes / 60))
    if refreshes == 6.3:
        holds("beat-of-6.3", found.worst_arcsec_per_deg_s)
    assert found.worst_arcsec_per_deg_s == pytest.approx(
        part * (1 - part) / 2 / refreshes * 60.0, rel=1e-6
    )
    assert found.worst_mag < 1e-9


def test_whole_refreshes_cure_the_light_of_a_panel_that_flashes_and_not_its_places():
    """Half of the dark, however long: a star is seen at the flashes alone."""
    for whole in (1, 6, 100):
        found = beat(Exposures(60.0, whole / 60, lit_s=1 / 240))
        assert found.worst_mag < 1e-6
        holds("flash-of-a-quarter", found.worst_arcsec_per_deg_s)
        assert found.worst_arcsec_per_deg_s == pytest.approx(
            0.75 / 2 / 60 * ARCSEC_PER_DEG, rel=1e-3
        )
    one_or_two = beat(Exposures(60.0, 1.5 / 60, lit_s=0.0))
    assert one_or_two.worst_mag == pytest.approx(2.5 * math.log10(1.5), rel=1e-3)
    # one flash or two of the mean's 1.2: more are further from it than fewer
    few_or_many = beat(Exposures(60.0, 1.2 / 60, lit_s=0.0))
    assert few_or_many.worst_mag == pytest.approx(2.5 * math.log10(2 / 1.2), rel=1e-3)
    assert beat(Exposures(60.0, 0.5 / 60, lit_s=0.0)).worst_mag == math.inf


def test_where_nothing_beats_nothing_is_said_to():
    assert beat(Exposures(60.0, 0.1)).worst_arcsec_per_deg_s == 0.0
    assert beat(Exposures(60.0, 0.1)).period_s is None
    assert beat(Exposures(60.0, 0.105, triggered=True)).worst_arcsec_per_deg_s == 0.0
    assert beat(Exposures(60.0, 0.0)).worst_arcsec_per_deg_s is None
    # the phase stands, where it happens to
    assert beat(Exposures(60.0, 0.105, frame_hz=7.5)).period_s is None
    assert beat(Exposures(60.0, 0.105, frame_hz=7.5)).worst_arcsec_per_deg_s > 0.9
    assert beat(Exposures(59.94, 0.1, 10.0)).period_s == pytest.approx(1 / 0.06)


@pytest.mark.parametrize(
    ("beyond", "period_s"), [(1e-4, 0.1 / 1e-4), (-1e-5, 0.1 / 1e-5), (1e-7, None)]
)
def test_an_exposure_beats_unless_it_is_whole_refreshes_within_a_millionth(beyond, period_s):
    """Exposures of 6 + f refreshes, one after the other, repeat after 1 / f of them."""
    found = beat(Exposures(60.0, (6 + beyond) / 60))
    if period_s is None:
        assert (found.period_s, found.worst_arcsec_per_deg_s) == (None, 0.0)
    else:
        assert found.period_s == pytest.approx(period_s, rel=1e-4)
        assert found.worst_arcsec_per_deg_s == pytest.approx(abs(beyond) / 2 / 6 * 60, rel=1e-3)


@pytest.mark.parametrize("wrong", [math.nan, math.inf, 0.0, -60.0])
def test_rates_that_are_none_are_refused(wrong):
    assert "refresh_hz" in refusal(Exposures, wrong, 0.1)
    assert "frame_hz" in refusal(Exposures, 60.0, 0.1, wrong)
    if wrong != 0:
        assert "exposure_s" in refusal(Exposures, 60.0, wrong)


# A beat of an arcsecond is over these.
TIGHT = {"tolerance_px": 0.02, "tolerance_mag": 0.02}


def beating_config(tmp_path, tracker, **tables):
    return parse_config(
        tmp_path / "bench.toml",
        bench_text(
            {"collimator": {"focal_length_mm": 350}, "tracker": tracker, "render": TIGHT}, tables
        ),
    )


WITHOUT = {
    "one after the other": ({"exposure_s": 0.105}, {}),
    "nearest above": ({"exposure_s": 0.045}, {}),
    "shorter than a refresh": ({"exposure_s": 0.012}, {}),
    "by the tracker's frames": ({"exposure_s": 0.045, "frame_hz": 20}, {}),
    "as many as its frames have room for": ({"exposure_s": 0.0455, "frame_hz": 21.9}, {}),
    "60 for 59.94": ({"exposure_s": 0.04}, {"monitor": {"refresh_hz": 59.94}}),
    "light of flashes": (
        {"exposure_s": 0.04},
        {"monitor": {"hold_ms": 15}, "sync": {"turn_deg_s": 0.1}},
    ),
}


@pytest.mark.parametrize(("tracker", "tables"), WITHOUT.values(), ids=WITHOUT)
def test_each_proposal_alone_is_without_a_beat_and_the_nearest(tmp_path, tracker, tables):
    found = beat_of(beating_config(tmp_path, tracker, **tables))
    assert found.matters and found.proposal.exposure_s is not None
    line = beat_line(found)
    monitor = tables.get("monitor", {})
    for table, key in (("monitor", "refresh_hz"), ("tracker", "exposure_s")):
        value = getattr(found.proposal, key)
        if value is None:
            continue
        assert f"[{table}] {key} = {value:.6g}" in line
        changed = {
            "monitor": dict(monitor),
            **{name: keys for name, keys in tables.items() if name != "monitor"},
        }
        if table == "monitor":
            cured = beating_config(
                tmp_path, tracker, **{**changed, "monitor": {**monitor, key: float(f"{value:.6g}")}}
            )
        else:
            cured = beating_config(tmp_path, {**tracker, key: float(f"{value:.6g}")}, **changed)
        again = beat_of(cured)
        assert not again.matters and beat_line(again) is None
        assert again.refreshes_per_exposure == pytest.approx(
            round(again.refreshes_per_exposure), abs=1e-4
        )
        room = 60 / tracker.get("frame_hz", 60.0) if key == "exposure_s" else math.inf
        assert abs(
            again.refreshes_per_exposure - found.refreshes_per_exposure
        ) <= 0.5 or room < math.ceil(room)


def test_the_line_has_the_amount_and_the_proposal(tmp_path):
    line = beat_line(beat_of(beating_config(tmp_path, {"exposure_s": 0.105})))
    assert (
        line
        == "exposures of 0.105 s are 6.3 refreshes of 60 Hz: a star is off by up to 1 arcsec at 1"
        " deg/s, in a beat of 0.35 s; without a beat: [monitor] refresh_hz = 57.1429 or"
        " [tracker] exposure_s = 0.1"
    )


@pytest.mark.parametrize(
    ("arcsec", "told"), [(0.123, "0.12"), (99.4, "99"), (99.6, "100"), (250.4, "250")]
)
def test_arcseconds_are_told_to_two_digits_without_an_exponent(tmp_path, arcsec, told):
    found = beat_of(beating_config(tmp_path, {"exposure_s": 0.105}))
    line = beat_line(msgspec.structs.replace(found, worst_arcsec=arcsec))
    assert f"off by up to {told} arcsec at 1 deg/s" in line


def test_what_does_not_matter_is_not_said(tmp_path):
    for tracker in (
        {"exposure_s": 0.1},
        {"exposure_s": 0.0},
        {"exposure_s": 0.105, "trigger": "external"},
    ):
        found = beat_of(beating_config(tmp_path, tracker))
        assert not found.matters and found.proposal is None and beat_line(found) is None
    measured = beat_of(beating_config(tmp_path, {"exposure_s": 0.1}), refresh_hz=59.94)
    assert measured.worst_arcsec < measured.tolerance_arcsec and beat_line(measured) is None
    slow = beating_config(tmp_path, {"exposure_s": 0.105}, sync={"turn_deg_s": 0.1})
    assert not beat_of(slow).matters


def test_a_display_s_own_modes_are_what_is_proposed(tmp_path):
    config = beating_config(tmp_path, {"exposure_s": 0.04})  # 2.4 refreshes
    assert beat_of(config, modes_hz=(60, 24, 50, 75, 100)).proposal.refresh_hz == 50
    assert beat_of(config, modes_hz=(60, 59)).proposal.refresh_hz is None
    # none that is farther off than a factor of 2, though it beats with nothing
    assert beat_of(config, modes_hz=(25, 125)).proposal.refresh_hz is None
    # the nearest, neither the slowest nor the fastest
    config = beating_config(tmp_path, {"exposure_s": 0.125})  # 7.5 refreshes
    assert beat_of(config, modes_hz=(96, 48, 64)).proposal.refresh_hz == 64
    # twice the rate is no farther off than that
    assert beat_of(config, modes_hz=(120,)).proposal.refresh_hz == 120
    assert beat_of(config, modes_hz=(128,)).proposal.refresh_hz is None


def test_a_panel_that_flashes_wants_a_trigger(tmp_path):
    found = beat_of(
        beating_config(tmp_path, {"exposure_s": 0.1, "frame_hz": 7.7}, monitor={"hold_ms": 1})
    )
    assert found.matters and found.proposal.exposure_s is found.proposal.refresh_hz is None
    assert found.proposal.frame_hz == pytest.approx(7.5)
    # one of seven has room in seven, though 0.07 times 100 is 7.000000000000001
    tracker = {"exposure_s": 0.07, "frame_hz": 13.9}
    monitor = {"hold_ms": 1, "refresh_hz": 100}
    whole = beat_of(beating_config(tmp_path, tracker, monitor=monitor))
    assert whole.proposal.frame_hz == pytest.approx(100 / 7)
    # an exposure of 2.3 refreshes has no room in two
    tracker = {"exposure_s": 2.3 / 60, "frame_hz": 25.0}
    long = beat_of(beating_config(tmp_path, tracker, monitor={"hold_ms": 1}))
    assert long.proposal.frame_hz == pytest.approx(20.0)
    assert (
        "trigger the tracker ([sync] port, [tracker] trigger); at [tracker] frame_hz = 7.5 its"
        " phase stands still" in beat_line(found)
    )


def test_an_amount_of_hundreds_is_written_without_an_exponent(tmp_path):
    found = beat_of(beating_config(tmp_path, {"exposure_s": 0.105}, sync={"turn_deg_s": 200}))
    assert "up to 200 arcsec at 200 deg/s" in beat_line(found)


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        (
            {"tracker": {"frame_hz": 20}},
            r"\[tracker\] frame_hz = 20: exposures of 0.1 s overlap; write 10 or less",
        ),
        (
            {"sync": {"port": "/dev/ttyUSB0", "pulse_ms": 20}},
            r"\[sync\] pulse_ms = 20: the next pulse is due after 16.67 ms",
        ),
        (
            {"sync": {"port": "/dev/x"}, "attitude": {"source": "serial", "port": "/dev/x"}},
            r"\[sync\] port = /dev/x: the attitude comes over it",
        ),
        (
            {"sync": {"port": "socket://bench:1"}},
            r"\[sync\] port = 'socket://bench:1': write .* \"rfc2217://HOST:PORT\"",
        ),
        ({"sync": {"port": ""}}, r"\[sync\] port = '': write .*; leave it out for no pulse"),
        (
            {"sync": {"port": "rfc2217://bench"}},
            r"'rfc2217://bench': write .* \"rfc2217://HOST:PORT\"",
        ),
        ({"sync": {"port": "/dev/tty\x07"}}, r"\[sync\] port = '/dev/tty\\x07': write"),
        ({"tracker": {"trigger": "yes"}}, "trigger"),
        ({"sync": {"every_frames": 0}}, "every_frames"),
        ({"sync": {"turn_deg_s": 0}}, "turn_deg_s"),
    ],
)
def test_keys_that_do_not_go_together_are_refused_in_a_line(tmp_path, tables, said):
    with pytest.raises(InputError, match=said):
        parse_config(tmp_path / "bench.toml", bench_text(tables))
