"""Whatever is named as a file, a number or an output: one line, soon, and nothing of the input
repeated at length.
"""

from __future__ import annotations

import json
import os
import py_compile
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import hilstar
from hilstar.attitude.logs.log_formats import readable
from hilstar.basics.errors import HilstarError, InputError, one_line
from hilstar.cli.app import run
from tests.support.benches import ROOT, SMALL_BENCH
from tests.support.commands import assert_refused, bounded_by, run_hilstar_here, typed
from tests.support.forks import HILSTAR, Started
from tests.support.full_disk import WITHOUT_BYTECODE, limited_environment
from tests.support.waiting import PATIENCE_S

MEMORY_BYTES = 4 << 30
BENCH = SMALL_BENCH.replace("[1024, 1024]", "[64, 64]").replace("[320, 240]", "[64, 48]")
FRAME = "frame bench.toml --radec 84,-1,0 --codes codes.png"
RESPONSE = "code,w\n" + "".join(f"{code},{(code / 255) ** 2.2 + 1e-3}\n" for code in range(256))
MONITOR = '[calibration]\nkind="photometric"\nwho=""\nwhen=""\ninstrument=""\nunit=""\nbits=8\nresponse="RESPONSE"\n'


@pytest.fixture(autouse=True)
def bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """In a directory of its own, with an alarm: whatever waits for ever fails, and does not stop
    the suite.
    """
    monkeypatch.chdir(tmp_path)
    with bounded_by(PATIENCE_S):
        yield


def command_refusal(*words: str) -> str:
    """The line with which a command refuses, in this process."""
    with pytest.raises(HilstarError) as error:
        run(typed(*words))
    assert error.value.exit_code == 2
    line = one_line(str(error.value))
    assert len(line) <= 1000
    return line


def place(kind: str, name: str) -> str:
    """The command that reads a file of one kind by its name, and everything else that it reads
    made well.
    """
    benches = {
        "curve": BENCH.replace('"ccd47-20"', f'"{name}"'),
        "transmission": BENCH.replace('"n-bk7-10mm"', f'"{name}"'),
        "catalogue": BENCH + f'[sky]\ncatalogue = "{name}"\n',
        "calibration": BENCH.replace("[monitor]\n", f'[monitor]\ncalibration = "{name}"\n'),
        "truth of verify": BENCH + f'[verify]\ntrue_calibration = "{name}"\n',
    }
    monitor = {
        "response": MONITOR.replace("RESPONSE", name),
        "grid": MONITOR.replace("RESPONSE", "r.csv") + f'[uniformity]\nfile="{name}"\n',
    }
    Path("r.csv").write_text(RESPONSE)
    Path("mon.toml").write_text(monitor.get(kind, MONITOR))
    with_monitor = BENCH.replace("[monitor]\n", '[monitor]\ncalibration = "mon.toml"\n')
    Path("bench.toml").write_text(benches.get(kind, with_monitor if kind in monitor else BENCH))
    key = f"--secret-key {name} --server-key {name}"
    commands = {
        "bench": f"budget {name}",
        "log": f"convert {name} out.csv",
        "replayed log": f"replay bench.toml {name} --headless",
        "ledger": f"report {name} -o report",
        "edges": f"latency none.mcap --edges {name}",
        "frame": f"compare {name} {name}",
        "patches": f"calibrate photometric {name} -o m.toml",
        "key": f"send --spin z,1 --count 1 --wait 0 --connect {key}",
        "truth of verify": "verify bench.toml --fields 1",
    }
    return commands.get(kind, FRAME)


PLACES = ("bench", "curve", "transmission", "catalogue", "calibration", "response", "grid", "log")
PLACES += ("truth of verify", "replayed log", "ledger", "edges", "frame", "patches", "key")


@pytest.mark.parametrize("kind", PLACES)
def test_what_is_no_file_or_too_large_is_refused_wherever_a_file_is_named(tmp_path, kind):
    os.mkfifo("pipe")
    size_gb = 10 if kind == "catalogue" else 1  # a table of stars may have 4
    with Path("large").open("wb") as file:
        file.truncate(size_gb * 10**9)
    names = {
        "pipe": "it is a pipe",
        "/dev/zero": "it is a device",
        "/dev/full": "it is a device",
        "/dev/urandom": "it is a device",
    }
    for name, reason in (
        names | {"large": "" if kind == "ledger" else f"{size_gb} GB or more"}
    ).items():
        absolute = str(tmp_path / name)
        line = command_refusal(
            place(kind, name if kind in {"response", "grid"} and name[0] != "/" else absolute)
        )
        assert reason in line, (name, line)
        assert Path(name).name in line


@pytest.mark.parametrize(
    ("head", "words"),
    [
        (b"DAF/SPK " + bytes(64), "a SPICE kernel"),
        (b"PK\x03\x04" + bytes(64), "a zip archive"),
        (b"\x1f\x8b\x08" + bytes(64), "a gzip file"),
        (b"\x89HDF\r\n\x1a\n", "an HDF5 file"),
        (b"SIMPLE  =                    T", "a FITS file"),
        (b"\x80\x04\x95" + bytes(64), "a pickle"),
        (b"t_s,qw,qx,qy,qz\n1,1,0,0,0\n\xff\x81", "it is no text: line 3 has a byte 0x81"),
        (bytes(64), "column t_s is missing"),
    ],
)
def test_a_log_of_another_format_is_named_with_those_that_are_read(head, words):
    Path("log").write_bytes(head)
    line = command_refusal("convert", "log", "out.csv")
    assert words in line
    assert readable() in line or "header must have" in line


@pytest.mark.parametrize("digits", [20, 4301])
def test_whole_numbers_of_any_length_are_refused_by_name(digits):
    number = "9" * digits
    Path("bench.toml").write_text(BENCH + f"[tracker.detector]\ndevice_seed = {number}\n")
    assert "device_seed" in command_refusal(FRAME) or "thousands of digits" in command_refusal(
        FRAME
    )
    Path("bench.toml").write_text(BENCH + f"[tracker.detector]\ndevice_seed = 0x{'f' * digits}\n")
    assert "device_seed" in command_refusal(FRAME)
    Path("bench.toml").write_text(BENCH)
    for text in (
        f"t_s,qw,qx,qy,qz,sequence\n1,1,0,0,0,{number}\n",
        f"t_s,qw,qx,qy,qz\n{number},1,0,0,0\n",
        f'{{"t_ns":{number},"q":[1,0,0,0]}}\n',
        f'{{"t_ns":1,"q":[1,0,0,0],"sequence":-{number}}}\n{{"t_ns":0,"q":[1,0,0,0]}}\n',
    ):
        Path("log").write_text(text)
        assert "log:" in command_refusal("convert", "log", "out.csv")
    Path("edges").write_text(f"host_ns,level\n{number},1\n")
    assert "edges:2: " in command_refusal("latency", "none.mcap", "--edges", "edges")


@pytest.mark.parametrize(
    "rows",
    [
        "1e300,1\n2e300,1\n",
        "400,1\n1e9,1\n",
        "-5,1\n5,1\n",
        "1e-300,1\n400,1\n",
        "400,nan\n500,1\n",
        "400,1\n400,1\n",
        "400,1e400\n500,1\n",
        "".join(f"{400 + k / 100},0.5\n" for k in range(10_001)),
    ],
)
def test_a_curve_that_no_sensor_has_is_refused(rows):
    Path("qe.csv").write_text(rows)
    Path("bench.toml").write_text(BENCH.replace('"ccd47-20"', '"qe.csv"'))
    assert "qe.csv:" in command_refusal(FRAME)


def test_a_key_of_thousands_of_parts_takes_no_minutes():
    Path("bench.toml").write_text(".".join(["a"] * 90_000) + " = 1\n")
    assert "a key has 32 parts or more" in command_refusal(FRAME)


@pytest.mark.parametrize(
    "text",
    [
        "".join(f"k{k:03}{'x' * 93} = 1\n" for k in range(192)),
        "[render]\n" + "k" * 100_000 + " = 1\n",
        '[render]\nquantisation = "' + "v" * 100_000 + '"\n',
        "[render]\nsprite_sigma_px = [" + "1, " * 30_000 + "1]\n",
        '[sky]\ncatalogue = "' + "c" * 100_000 + '"\n',
        '[tracker]\nquantum_efficiency = "' + "c d" * 30_000 + '"\n',
        '[render]\n"a`] - at `$.x[" = 1\n',
    ],
)
def test_a_refusal_repeats_little_of_a_bench_file(text):
    Path("bench.toml").write_text(text if text.startswith(("k", "[tracker]")) else BENCH + text)
    assert len(command_refusal(FRAME)) < 700


SIMULATE = "simulate bench.toml --radec 84,-1,0 -o o.fits"


@pytest.mark.parametrize("value", ["5e-324", "1e-310", "1e-200"])
@pytest.mark.parametrize("key", ["quantum_efficiency", "transmission"])
@pytest.mark.parametrize(
    "words",
    [FRAME, SIMULATE, "budget bench.toml", "doctor bench.toml"],
    ids=lambda line: line.partition(" ")[0],
)
def test_a_curve_of_next_to_nothing_is_refused(words, key, value):
    lines = [line for line in BENCH.splitlines() if not line.startswith(f"{key} =")]
    Path("bench.toml").write_text(
        "\n".join(lines).replace("[tracker]", f"[tracker]\n{key} = {value}")
    )
    assert f"[tracker] {key} = {value}: write a number from 1e-06 to 1" in command_refusal(words)


def test_a_curve_of_next_to_nothing_in_a_file_is_refused():
    Path("qe.csv").write_text("wavelength_nm,value\n400,5e-324\n900,5e-324\n")
    Path("bench.toml").write_text(BENCH.replace('"ccd47-20"', '"qe.csv"'))
    refused = command_refusal(FRAME)
    assert "quantum_efficiency" in refused or "no electron" in refused


@pytest.mark.parametrize(
    ("table", "line"),
    [
        ("tracker", "psf_sigma_px = [32768, 32768]"),
        ("tracker", "psf_sigma_px = [1e308, 1e308]"),
        ("render", "sprite_sigma_px = [32768, 1]"),
        ("tracker", "principal_point_px = [1e308, 1e308]"),
        ("collimator", "principal_point_px = [-1e308, 1]"),
        ("background", "gradient_electrons_across = [1e308, 0]"),
    ],
)
def test_a_number_that_no_bench_has_is_refused_before_it_takes_memory(table, line):
    key = line.partition(" =")[0]
    lines = [other for other in BENCH.splitlines() if not other.startswith(f"{key} =")]
    lines += [] if f"[{table}]" in lines else [f"[{table}]"]
    lines.insert(lines.index(f"[{table}]") + 1, line)
    Path("bench.toml").write_text("\n".join(lines) + "\n")
    for words in (FRAME, SIMULATE):
        assert f"[{table}] {key} = " in command_refusal(words)


BURST = '[[fault]]\nname = "protons"\nkind = "cosmic-rays"\nat_s = 0\nnumber = 4\nelectrons = 800\n'


@pytest.mark.parametrize(
    "words",
    [
        "budget bench.toml --noise -o budget",
        "tracker bench.toml --watch tcp://127.0.0.1:5563 --answer tcp://127.0.0.1:5564",
        f"{SIMULATE} --scenario burst.toml",
        f"{FRAME} --scenario burst.toml",
    ],
    ids=lambda line: line.partition(" ")[0],
)
def test_an_exposure_of_no_length_is_refused_where_light_is_divided_by_it(words):
    Path("bench.toml").write_text(BENCH.replace("[tracker]", "[tracker]\nexposure_s = 0"))
    Path("burst.toml").write_text(BURST)
    assert "exposure_s" in command_refusal(words)


def test_a_noise_budget_of_no_star_is_refused():
    Path("bench.toml").write_text(BENCH + "\n[sky]\nfaintest_v_mag = -3\n")
    assert "[sky] faintest_v_mag = -3 leaves no star" in command_refusal(
        "budget bench.toml --noise -o budget"
    )


@pytest.mark.parametrize(("table", "size"), [("tracker", "[64, 64]"), ("monitor", "[64, 48]")])
def test_an_image_of_a_thousand_million_pixels_is_refused(table, size):
    assert BENCH.count(f"resolution_px = {size}") == 1
    Path("bench.toml").write_text(BENCH.replace(size, "[32768, 32768]"))
    assert (
        f"[{table}] resolution_px = [32768, 32768]: 1074 million pixels; write 67 million at most"
        in command_refusal(FRAME)
    )


def test_whoever_calls_from_python_gets_a_bounded_line_too():
    Path("bench.toml").write_text(BENCH.replace('"ccd47-20"', '"' + "x" * 100_000 + '"'))
    with pytest.raises(InputError) as refused:
        hilstar.load("bench.toml")
    assert len(str(refused.value)) < 700


@pytest.mark.parametrize(
    "words",
    ["--help", "frame --help", "convert log.csv out.csv", f"{FRAME} --json"],
)
def test_a_full_stdout_is_one_line(words):
    Path("bench.toml").write_text(BENCH)
    Path("log.csv").write_text("t_s,qw,qx,qy,qz\n0,1,0,0,0\n")
    with (
        Path("/dev/full").open("w") as full,
        Started(
            [*HILSTAR, *typed(words)], stdout=full, stderr=subprocess.PIPE, text=True
        ) as process,
    ):
        _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode in {1, 2}
    assert len(err.splitlines()) == 1, err
    assert "stdout" in err


def limited() -> None:
    """No file of more than 4 kB, and no more memory than the issue allows."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))


@pytest.mark.parametrize(
    "words",
    [
        "frame bench.toml --radec 84,-1,0 -o o.fits",
        "simulate bench.toml --log log.csv -o frames",
        "convert long.csv out.aem",
        "demo -o demo --duration 0.5",
        "study models -o study",
    ],
)
def test_a_full_disk_is_one_line(words):
    Path("bench.toml").write_text(BENCH)
    Path("log.csv").write_text("t_s,qw,qx,qy,qz\n0,1,0,0,0\n1,1,0,0,0\n")
    Path("long.csv").write_text("t_s,qw,qx,qy,qz\n" + "".join(f"{k},1,0,0,0\n" for k in range(500)))
    command = [sys.executable, "-m", "hilstar", *typed(words)]
    result = subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
        preexec_fn=limited,
        env=limited_environment(),
    )
    assert_refused(result, 2, "cannot be written")


@pytest.mark.parametrize(
    ("module", "kept"),
    [("instruments/study/models.py", 200), ("cli/app.py", 16), ("basics/errors.py", 200)],
)
def test_a_compiled_module_that_a_full_disk_cut_short_is_named(tmp_path, module, kept):
    """Marshal reads past its end: an EOFError, which click takes for Ctrl-C."""
    source = ROOT / "hilstar" / module
    compiled = (
        tmp_path
        / "cache"
        / source.with_suffix(f".{sys.implementation.cache_tag}.pyc").relative_to("/")
    )
    py_compile.compile(str(source), cfile=str(compiled), doraise=True)
    os.truncate(compiled, kept)
    environment = os.environ | {"PYTHONPYCACHEPREFIX": str(tmp_path / "cache")} | WITHOUT_BYTECODE
    command = [sys.executable, "-m", "hilstar", "study", "models", "-o", "study", "--quick"]
    result = subprocess.run(
        command, capture_output=True, text=True, timeout=PATIENCE_S, check=False, env=environment
    )
    assert_refused(result, 2, str(compiled), "damaged", "delete")


def test_names_that_are_not_utf_8_are_as_good_as_others():
    bench, codes = os.fsdecode(b"b\xff.toml"), os.fsdecode(b"c\xfe.png")
    Path(bench).write_text(BENCH)
    Path("log.csv").write_text("t_s,qw,qx,qy,qz\n0,1,0,0,0\n")
    result = run_hilstar_here("frame", bench, "--radec", "84,-1,0", "--codes", codes, "--json")
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["written"] == [codes]
    result = run_hilstar_here(
        "replay", bench, "log.csv", "--headless", "--speed", "max", "--ledger", "run.mcap"
    )
    assert result.returncode == 0, result.stderr
    assert_refused(
        run_hilstar_here(
            "frame", os.fsdecode(b"n\xff.toml"), "--radec", "84,-1,0", "--codes", "c.png"
        ),
        2,
        "n\\xff.toml",
    )


def test_a_name_of_300_characters_is_refused_in_short():
    line = refusal_of_process("keys", "-o", "k" * 300)
    assert "File name too long" in line
    assert len(line) < 300


def refusal_of_process(*words: str) -> str:
    result = run_hilstar_here(*words)
    assert_refused(result, 2)
    return result.stderr


@pytest.mark.parametrize(
    "words",
    [
        ("frame", "bench.toml", "--radec", "9" * 100_000 + ",1,2", "-o", "x.fits"),
        ("benchmark", "--stars", "1" * 100_000),
        ("simulate", "bench.toml", "--radec", "1,2,3", "--seed", "9" * 6000, "-o", "x.fits"),
        ("frame" + "s" * 100_000,),
        ("send", "--spin", "z,1", "--to", "x" * 100_000),
    ],
)
def test_a_refusal_repeats_little_of_the_command_line(words):
    Path("bench.toml").write_text(BENCH)
    line = refusal_of_process(*words)
    assert len(line) < 500  # the names of all commands among them
    assert "write" in line or "--help" in line
