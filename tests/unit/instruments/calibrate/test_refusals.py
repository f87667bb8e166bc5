"""Calibrations that are refused: files, commands and calls, and the words of the one line that says
so. What only a planted bench can show stands beside the plant: geometric, alignment, reference.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from hilstar.instruments.calibrate.camera_edges import check_rate, find_square
from hilstar.instruments.calibrate.first_light.photometry import plan_for
from hilstar.instruments.calibrate.latency import Edges, pair
from hilstar.instruments.calibrate.photometric import calibrate_photometric
from hilstar.instruments.calibrate.plan import PlanSettings, plan_patches, write_plan
from hilstar.instruments.calibrate.sensor import import_emva
from hilstar.instruments.calibrate.warm_up import judge_warm_up, watch_white
from hilstar.server.bench.config import read_config
from hilstar.server.genicam.camera import Film
from tests.support.benches import SMALL_BENCH, TWIN, bench_text
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.planted_run import write_ledger
from tests.support.refusals import assert_file_refused, refusal, says
from tests.support.tables import readings_text

STEPS = [0, 1, *range(5, 256, 10)]


def photometric(path: Path) -> None:
    """Calibrate from a file of measurements; its calibration must not be there afterwards."""
    output = path.with_name("monitor.toml")
    try:
        calibrate_photometric(path, output)
    finally:
        assert not output.exists()


def ramp(codes: list[int]) -> list[tuple[int, str, float]]:
    """Three readings a code of a monitor whose light is a power of its codes."""
    light = [(code / 255) ** 2.2 + 1e-3 for code in codes]
    return [
        (code, "w", value * (1 + 1e-3 * (k - 1)))
        for k in range(3)
        for code, value in zip(codes, light, strict=True)
    ]


RAMP = ramp(STEPS)
HELD = [(code, name, min(value, 0.801)) for code, name, value in RAMP]
COUNTS = [(code, name, min(round(4000 * value / 0.85), 4095)) for code, name, value in RAMP]
FALLING = [(code, name, value * (0.7 if code == 125 else 1)) for code, name, value in RAMP]
# measured in an order by chance, while the light falls by 3 %
DRIFTING = [
    (*RAMP[k][:2], RAMP[k][2] * left)
    for k, left in zip(
        np.random.default_rng(3).permutation(len(RAMP)),
        np.linspace(1, 0.97, len(RAMP)),
        strict=True,
    )
]
TIMED = sorted((*row, 10.0 * k) for k, row in enumerate(DRIFTING))
HEAD = "code,channel,value"
MEASUREMENTS = [
    ("", "has no measurement"),
    ("code,value\n", "the column channel is missing"),
    (f"{HEAD},colour\n", "unknown or repeated column"),
    ("code,code,channel,value\n", "column code is there twice"),
    (f"{HEAD}\n1,w\n", ":2: 2 cells"),
    (f"{HEAD}\n1,w,\n", "line 2: value is empty"),
    (f"{HEAD}\n# so\n1.5,w,2\n", "line 3: code = 1.5"),
    (f"{HEAD}\n-1,w,2\n", "code = -1"),
    (f"{HEAD}\n70000,w,2\n", "code = 70000"),
    (f"{HEAD}\n1,x,2\n", "channel = x; write w, r, g or b"),
    (f"{HEAD}\n1,w,nan\n", "value = nan; write a finite number"),
    (f"{HEAD}\n1,w,-2\n", "light is not negative"),
    (f"{HEAD}\n1,w,bright\n", "value = bright"),
    (f"{HEAD},exposure_s\n1,w,2,0\n", "exposure_s = 0"),
    (f"{HEAD},t_s\n1,w,2,\n2,w,2,1\n", "t_s is empty in some rows"),
    (f"{HEAD}\n1,r,2\n", "only channel r"),
    (f"{HEAD}\n1,w,2\n1,r,2\n", "measure w alone, or all of r, g and b"),
    (readings_text(ramp([0, 300])), "white, code 1023 of 10 bits"),
    (readings_text(ramp(STEPS[1:])), "code 0 is not measured"),
    (readings_text(ramp(STEPS[:-1])), "white, code 255 of 8 bits, is not measured"),
    (readings_text(ramp([0, 10, 20, 40, 80, 160, 255])), "7 distinct codes; measure 10 or more"),
    (readings_text(HELD), "saturated or the link clips"),
    (readings_text(COUNTS), "codes 245 to 255 read the same"),
    # light that falls beyond the noise
    (readings_text(FALLING), "code 115 to code 125"),
    (readings_text(DRIFTING), "light drifts by -"),
    # the same rows sorted, their times beside them
    (readings_text(TIMED, f"{HEAD},t_s"), "light drifts by -"),
    ("\xff\xfe\x00", "not UTF-16 to its end"),
]
SHEETS = [
    ("sigma_d,6,e-", "has no K"),
    ("K,0.25,e-/DN", ":2: K = 0.25 e-/DN; write it above 0 in dn/e-"),
    ("K,0,DN/e-", "above 0"),
    ("K,much,DN/e-", "is not a finite number"),
    ("K,0.25,DN/e-\neta,60,%", "eta@530nm"),
    ("K,0.25,DN/e-\neta@530nm,140,%", ": eta@530nm = 140 %; write it from 0 to 100 %"),
    ("K,0.25,DN/e-\neta@530nm,40,%\neta@530nm,44,%", "a wavelength twice"),
    ("K,0.25,DN/e-\nbits,40,bit", ": bits = 40; write a number from 1 to 16"),
    (
        "K,0.25,DN/e-\nK,0.5,DN/e-\nsigma_d,2.5,e-",
        ":3: K makes gain_e_per_dn 2, and line 2 has K for 4; leave one of them",
    ),
    ("K,0.25,DN/e-\n1/K,5,e-/DN", ":3: 1/K makes gain_e_per_dn 5, and line 2 has K for 4"),
    (
        "K,0.25,DN/e-\nsigma_d,2.5,e-\nσ_d,2.6,e⁻",
        ":4: σ_d makes read_noise_e 2.6, and line 3 has sigma_d for 2.5",
    ),
    (
        "sigma_d,1.2,DN\nsigma_d,2.5,e-\nK,0.25,DN/e-",
        ":2: sigma_d makes read_noise_e 4.8, and line 3 has sigma_d for 2.5",
    ),
]
ALIGNMENTS = [
    ("q_mon_to_reference = [1.0, 0.0, 0.0, 1.0]", "norm is 1.41421"),
    (
        "q_mon_to_reference = [1.0, 0.0, 0.0, 0.0]\n"
        "covariance_arcsec2 = [[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]",
        "no covariance",
    ),
]
FILES = [
    *((photometric, text.encode("latin-1"), words) for text, words in MEASUREMENTS),
    *((import_emva, f"quantity,value,unit\n{rows}\n".encode(), words) for rows, words in SHEETS),
    *(
        (read_config, f"{bench_text()}\n[alignment]\n{keys}\n".encode(), words)
        for keys, words in ALIGNMENTS
    ),
]


@pytest.mark.parametrize(
    ("read", "data", "words"), FILES, ids=[words[:60] for _, _, words in FILES]
)
def test_a_file_that_makes_no_calibration_is_refused_in_one_line(tmp_path, read, data, words):
    path = tmp_path / "file"
    path.write_bytes(data)
    assert_file_refused(read, path, words)


def test_a_plan_that_was_not_filled_in_and_a_file_that_is_not_there_are_refused(tmp_path):
    write_plan(tmp_path / "plan.csv", plan_patches(PlanSettings(8), np.random.default_rng(1)))
    assert_file_refused(photometric, tmp_path / "plan.csv", "fill it in")
    assert_file_refused(photometric, tmp_path / "none.csv", "cannot be read")


def test_a_table_of_light_does_not_write_over_the_measurements(tmp_path):
    path = tmp_path / "monitor.csv"
    path.write_text("\ufeff" + readings_text(ramp(STEPS)))  # a byte-order mark is no fault
    assert "written over" in refusal(photometric, path)


RNG = np.random.default_rng(5)
ALTERNATING = np.arange(400) % 2
REFRESH_NS = 1e9 / 60
SHOWN = Edges(np.round(np.arange(400) * REFRESH_NS).astype(np.int64), ALTERNATING)
STRANGE = Edges(np.sort(RNG.integers(0, SHOWN.host_ns[-1], 200)), RNG.integers(0, 2, 200))
NOISE = RNG.integers(18, 26, (40, 48, 64)).astype(np.uint8)
FILM = Film(NOISE, np.arange(40), np.arange(40), 0.01, 0)
EVERY_30_MS = 30_000_000 * np.arange(50)
CALLS = [
    *(
        (partial(PlanSettings, **({"bits": 8} | keys)), "; write ")
        for keys in (
            {"bits": 17},
            {"levels": 1},
            {"levels": 300},
            {"repeats": 0},
            {"channels": ""},
            {"channels": "ww"},
            {"channels": "wx"},
        )
    ),
    (partial(plan_for, 8, 12), "24 or more"),
    (partial(pair, STRANGE, SHOWN, REFRESH_NS / 4), "edges fit"),
    (partial(watch_white, lambda: 0.0, lambda: 0, lambda seconds: None), "white reads 0"),
    (partial(judge_warm_up, np.arange(5.0), np.ones(5)), "12 or more"),
    (partial(find_square, FILM), "nothing blinks...point it at the square"),
    (
        partial(check_rate, EVERY_30_MS, 0.004, 60.0),
        "every 30 ms...every 16.7 ms...AcquisitionFrameRate",
    ),
]


@pytest.mark.parametrize(("call", "words"), CALLS, ids=[words[:40] for _, words in CALLS])
def test_a_call_that_cannot_be_done_is_refused_in_one_line(call, words):
    line = refusal(call)
    assert says(line, words), line


# of bench.toml, twin.toml, run.mcap and e.csv
COMMANDS = [
    ("calibrate scale bench.toml --reading 26311", "HIP,DN"),
    ("calibrate scale bench.toml --reading 26311,-5", "HIP,DN"),
    ("calibrate scale bench.toml --reading 1,100", "no such star"),
    ("calibrate scale bench.toml --reading 26311,100 --exposure 0", "--exposure"),
    ("calibrate scale bench.toml --reading 26311,100 -o /nowhere/x.toml", "beside"),
    ("calibrate scale bright.toml --reading 32349,100", "clips"),
    ("calibrate photometric none.csv -o m.toml", "none.csv"),
    ("calibrate plan -o p.csv --channels x", "channels"),
    ("calibrate plan -o p.csv --resolution 10", "--resolution"),
    ("calibrate plan -o no/p.csv", "no/p.csv"),
    ("calibrate focus twin.toml", "give --grab CMD or a camera, or --virtual TRUTH.toml"),
    ("calibrate focus twin.toml --answers --virtual t.toml", "one of them"),
    ("calibrate focus twin.toml --answers", "--radec RA,DEC,ROLL"),
    ("calibrate focus twin.toml --answers --radec 84,-1,0 --headless", "add --feed"),
    ("calibrate focus twin.toml --answers --radec 84,-1,0 --exposure 1", "--exposure"),
    ("calibrate focus twin.toml --virtual t.toml --radec 84,-1,0", "are for --answers"),
    ("calibrate focus twin.toml --virtual t.toml --headless", "--headless"),
    ("calibrate focus twin.toml --answers --radec 84,-1,0", "has no [answers]"),
    (
        "calibrate focus packets.toml --answers --radec 84,-1,0 --headless --feed tcp://127.0.0.1:*",
        'format = "packet" carries no stars...--grab CMD',
    ),
    (
        'latency run.mcap --grab "take {output}"',
        "a command takes one image at a time; write genicam:NAME",
    ),
    ("latency run.mcap --grab genicam: --edges e.csv", "give the edges with one of"),
    ("latency run.mcap --edges e.csv --exposure 0.1", "--exposure: is for --grab"),
    ("latency run.mcap", "--grab genicam:NAME"),
    ("sensor import emva.csv -o sensor.toml", "emva.csv: ...has no K"),
]
PACKETS = '[answers]\nsource = "udp"\nbind = "127.0.0.1:9"\nclock = "host"\nformat = "packet"\n'


@pytest.fixture(scope="module")
def session(tmp_path_factory) -> Path:
    """The files that the commands name."""
    folder = tmp_path_factory.mktemp("session")
    (folder / "bench.toml").write_text(SMALL_BENCH)
    (folder / "bright.toml").write_text(SMALL_BENCH + "[render]\nbrightest_v_mag = 3\n")
    (folder / "twin.toml").write_text(bench_text(TWIN))
    (folder / "packets.toml").write_text(bench_text(TWIN) + PACKETS)
    (folder / "e.csv").write_text("host_ns,level\n")
    (folder / "emva.csv").write_text("quantity,value,unit\nsigma_d,6,e-\n")
    write_ledger(folder / "run.mcap", np.arange(3.0), None)
    return folder


@pytest.mark.parametrize(("command", "words"), COMMANDS, ids=[command for command, _ in COMMANDS])
def test_a_command_that_cannot_be_done_is_refused_with_exit_code_2(session, command, words):
    before = set(session.iterdir())
    result = run_hilstar_here(command, cwd=session)
    assert_refused(result, 2)
    assert says(result.stderr, words), result.stderr
    assert set(session.iterdir()) == before
