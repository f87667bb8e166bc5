"""A wrong word, or numbers with spaces between them: the line says what to type."""

from __future__ import annotations

import pytest

from hilstar.cli import entry
from hilstar.server import send_log
from tests.support.benches import ROOT
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.senders import free_port

BENCH = str(ROOT / "examples" / "bench.toml")
README = str(ROOT / "README.md")
MEANT = "84.057,-1.2,0, with commas and without spaces"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["displays"], "`hilstar doctor` lists the displays"),
        (["fram"], "did you mean frame?"),
        (["nonsense"], "the commands are demo, frame"),
        (["calibrate", "dot"], "did you mean dots?"),
        (["service", "instal"], "did you mean install?"),
        (["frame", BENCH, "--radecc", "1,2,3"], "did you mean --radec?"),
        (["frame", BENCH, "--nonsense"], "its options are --radec"),
        (["study", "chian", "-o", "d"], "did you mean chain?"),
        (["simulate", BENCH, "--noise", "ful"], "did you mean full?"),
        (["budget", BENCH, "--centroider", "windw"], "did you mean window?"),
        (["replay", BENCH, "log.csv", "--speed", "realtme"], "did you mean realtime?"),
        (["first-light", BENCH, "-o", "s", "--again", "verfy"], "did you mean verify?"),
        (
            ["frame", BENCH, "--radec", "84.057", "-1.2", "0", "-o", "o.fits"],
            f"write --radec {MEANT}",
        ),
        (
            ["frame", BENCH, "--radec", "84.057,", "-1.2,", "0", "-o", "o.fits"],
            f"write --radec {MEANT}",
        ),
        (["frame", BENCH, "--radec=84.057", "-1.2", "0", "-o", "o.fits"], f"write --radec {MEANT}"),
        (
            ["frame", BENCH, "--radec", "84.057 -1.2 0", "-o", "o.fits"],
            "with commas and without spaces",
        ),
        (["frame", BENCH, "--star", "alpha", "Lyr", "-o", "o.fits"], "write --star 'alpha Lyr'"),
        (["frame", "--star", "Proxima", "Centauri,30", BENCH], "--star 'Proxima Centauri,30'"),
        (["frame", BENCH, "--star=HIP", "27989", "-o", "o.fits"], "write --star 'HIP 27989'"),
        (["frame", BENCH, "--star", "Vega", "spare"], "unexpected extra argument(s) (spare)"),
        (["attitude", BENCH, "--time", "3"], "a live stream has only its present"),
        (
            ["budget", BENCH, "--noise", "--centroider", "box5"],
            "budget --noise: has every centroider",
        ),
        (
            ["convert", README, "o.csv", "--mounting", "1,0,0,0", "--convention", "frame=cam"],
            "write frame=body, or leave out --mounting",
        ),
        (
            ["latency", README, "--edges", BENCH, "--write", BENCH],
            "is read or written by this command already",
        ),
        (
            ["calibrate", "reference", BENCH, "-o", BENCH],
            "is read or written by this command already",
        ),
        (["calibrate", "--nonsense"], "No such option: --nonsense; write it after a command"),
        (
            ["simulate", BENCH, "--radec", "1,2,3", "--slew", "0", "1", "0", "-o", "o.fits"],
            "write --slew 0,1,0",
        ),
    ],
    ids=lambda value: " ".join(value).replace(BENCH, "BENCH") if isinstance(value, list) else None,
)
def test_a_wrong_word_is_answered_with_the_right_one(words, said, tmp_path):
    assert_refused(run_hilstar_here(*words, cwd=tmp_path), 2, said)


def test_numbers_after_commas_are_no_reason_to_complain_of_spaces(tmp_path):
    refused = run_hilstar_here(
        "frame", BENCH, "--radec", "84.057,-1.2,0", "--nonsense", cwd=tmp_path
    )
    assert_refused(refused, 2, "No such option: --nonsense")


@pytest.mark.parametrize(
    ("table", "line", "said"),
    [
        ("tracker", "resolution_px = 1024", "such as resolution_px = [1024, 1024]"),
        ("tracker", "psf_sigma_px = 0.6", "such as psf_sigma_px = [0.6, 0.6]"),
        ("collimator", "q_cam_to_mon = [1, 0]", "such as q_cam_to_mon = [1.0, 0.0, 0.0, 0.0]"),
        ("attitude", 'allow = "10.0.0.1"', 'such as allow = ["10.0.0.1"]'),
        ("monitor", 'bits = "8"', "such as bits = 8"),
        ("render", 'quantisation = "exakt"', "did you mean exact?"),
        ("monitor", "rotate_deg = 45", "0 or 90 or 180 or 270 is wanted"),
        ("attitude", 'source = "zqm"', "did you mean zmq?"),
        ("tracker", 'quantum_efficiency = "ccd47-2"', "did you mean ccd47-20?"),
        ("monitor", 'calibration = "sRGB"', "did you mean srgb?"),
        ("monitor", 'calibration = "gama2.2"', "did you mean gamma2.2?"),
        ("tracker", "aperture = 30", "did you mean aperture_mm?"),
    ],
)
def test_a_wrong_value_is_answered_with_an_example(table, line, said, tmp_path):
    tables = {
        "tracker": [
            "aperture_mm = 30",
            "focal_length_mm = 70",
            "pixel_pitch_um = 13",
            "resolution_px = [64, 64]",
        ],
        "monitor": ["resolution_px = [64, 48]", "pixel_pitch_um = 57.65"],
        "collimator": ["focal_length_mm = 350"],
    }
    tables["tracker"].append('quantum_efficiency = "ccd47-20"')
    key = line.partition(" =")[0]
    rest = [other for other in tables.get(table, []) if not other.startswith(f"{key} =")]
    tables[table] = [*rest, line]
    text = "\n".join(f"[{name}]\n" + "\n".join(lines) for name, lines in tables.items())
    (tmp_path / "bench.toml").write_text(text + "\n")
    assert_refused(run_hilstar_here("doctor", "bench.toml", cwd=tmp_path), 2, said)


def test_too_little_memory_is_the_machine_s_fault_and_no_input_s(monkeypatch):
    def without_memory(words):
        raise MemoryError

    monkeypatch.setattr(entry, "run", without_memory)
    done = run_hilstar_here("doctor")
    assert (done.returncode, done.stdout) == (3, "")
    assert done.stderr == "hilstar: not enough memory for this; give smaller files or sizes\n"


def test_a_file_that_went_away_is_named_in_one_line(monkeypatch, tmp_path):
    def without_its_file(words):
        (tmp_path / "gone").read_text()

    monkeypatch.setattr(entry, "run", without_its_file)
    done = run_hilstar_here("doctor")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        f"hilstar: {tmp_path}/gone: cannot be written or read (No such file or directory);"
        " choose another place\n"
    )


def test_send_s_jitter_is_milliseconds(monkeypatch):
    given = []
    made = send_log.Faults

    def faults(*values):
        given.append(values)
        return made(*values)

    monkeypatch.setattr(send_log, "Faults", faults)
    words = ["--spin", "z,0", "--count", "1", "--wait", "0", "--lose", "25%", "--jitter", "2"]
    assert (
        run_hilstar_here("send", "--to", f"udp://127.0.0.1:{free_port()}", *words).returncode == 0
    )
    assert given == [(0.25, 0.0, 0.0, 0.002)]
