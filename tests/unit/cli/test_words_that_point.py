"""Refusals and hints that name what is wrong, not its neighbour."""

from pathlib import Path

import pytest

from hilstar.basics.errors import InputError, MachineError
from hilstar.basics.resources import resource_path
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.cameras import fields_of_view
from hilstar.server.doctor import BenchReport
from hilstar.server.screen.gate import size_fault
from hilstar.sky.spectrum import QUANTUM_EFFICIENCIES, TRANSMISSIONS, load_curve
from tests.support.commands import run_hilstar, run_hilstar_here

DEMO = resource_path("configs", "demo.toml")
TEXT_OUTPUTS = (
    ["frame", str(DEMO), "--radec", "84.057,-1.2,0", "--truth", "-"],
    ["calibrate", "plan", "-o", "-"],
    ["catalogue", str(DEMO), "--faintest", "2", "-o", "-"],
)
OTHER_OUTPUTS = (
    ["frame", str(DEMO), "--radec", "84,-1,0", "-o", "-"],
    ["simulate", str(DEMO), "--radec", "84,-1,0", "-o", "-"],
    ["fmu", str(DEMO), "-o", "-"],
    ["budget", str(DEMO), "-o", "-"],
    ["verify", str(DEMO), "-o", "-"],
    ["certify", str(DEMO), "-o", "-"],
    ["report", "run.mcap", "-o", "-"],
    ["assess", "run.mcap", "-o", "-"],
    ["study", "models", "-o", "-"],
    ["demo", "-o", "-"],
    ["keys", "-o", "-"],
    ["sensor", "import", "emva.csv", "-o", "-"],
    ["calibrate", "photometric", "measured.csv", "-o", "-"],
)


@pytest.mark.parametrize("words", TEXT_OUTPUTS, ids=lambda words: words[0])
def test_a_dash_is_stdout_for_text_and_nothing_else_goes_there(
    words: list[str], tmp_path: Path
) -> None:
    done = run_hilstar(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    header, *rows = done.stdout.splitlines()
    assert len(rows) > 3
    assert all(row.count(",") >= header.count(",") for row in rows)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", OTHER_OUTPUTS, ids=lambda words: words[0])
def test_a_dash_is_refused_for_any_other_output(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = run_hilstar_here(*words)
    assert done.returncode == 2
    assert "-o -:" in done.stderr
    assert "stdout" in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_dash_and_json_both_want_stdout() -> None:
    done = run_hilstar_here("calibrate", "plan", "-o", "-", "--json")
    assert done.returncode == 2
    assert "both are for stdout" in done.stderr


@pytest.mark.parametrize("words", [[], ["calibrate"], ["sensor"], ["optics"], ["service"]])
def test_no_command_prints_the_help(words: list[str]) -> None:
    done = run_hilstar_here(*words)
    assert done.returncode == 2
    assert "COMMAND [ARGS]" in done.stdout
    assert "Missing command" not in done.stderr


@pytest.mark.parametrize(
    "words",
    [
        ["frame", "gone.toml"],
        ["simulate", "gone.toml"],
        ["report", "gone.mcap"],
        ["assess", "gone.mcap"],
        ["catalogue", "gone.toml"],
        ["calibrate", "photometric", "gone.csv"],
        ["calibrate", "geometric", "gone.toml", "gone.csv"],
    ],
    ids=" ".join,
)
def test_a_missing_file_is_said_before_a_missing_option(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = run_hilstar_here(*words)
    assert done.returncode == 2
    assert "gone." in done.stderr
    assert "o such file" in done.stderr
    assert "Missing option" not in done.stderr


def test_a_missing_option_of_files_that_are_there_is_still_said() -> None:
    done = run_hilstar_here("catalogue", str(DEMO))
    assert done.returncode == 2
    assert "Missing option" in done.stderr


def test_a_wrong_name_of_a_curve_is_offered_those_of_its_kind() -> None:
    with pytest.raises(InputError, match='write "ccd47-20", "kai-4021", "icx285"') as refused:
        load_curve("cmv4000", "[tracker] quantum_efficiency", built_in=QUANTUM_EFFICIENCIES)
    assert "bk7" not in str(refused.value)
    with pytest.raises(InputError, match='write "n-bk7-10mm", a CSV'):
        load_curve("bk7", "[tracker] transmission", built_in=TRANSMISSIONS)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("quantum_efficiency", '"n-bk7-10mm"', '"ccd47-20", "kai-4021", "icx285"'),
        ("transmission", '"ccd47-20"', '"n-bk7-10mm", a CSV'),
    ],
)
def test_a_bench_file_s_curve_of_another_kind_is_refused(
    key: str, value: str, words: str, tmp_path: Path
) -> None:
    done = run_hilstar_here("budget", str(_bench(tmp_path, key, value)))
    assert done.returncode == 2
    assert words in done.stderr


def _bench(folder: Path, key: str, value: str) -> Path:
    """The demo's bench with one key of [tracker] changed."""
    lines = DEMO.read_text().splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith(f"{key} "))
    lines[at] = f"{key} = {value}"
    path = folder / "bench.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_an_aperture_that_is_the_f_number_is_told_by_each_command_that_draws(
    tmp_path: Path,
) -> None:
    path = _bench(tmp_path, "aperture_mm", "1.8")
    focal_length_mm = read_bench_file(path).config.tracker.focal_length_mm
    fields = fields_of_view(read_bench_file(path).config, tmp_path)
    assert fields.warning is not None
    assert f"the f-number, which is {focal_length_mm / 1.8:.6g}" in fields.warning
    for words in (
        ["budget", str(path)],
        ["simulate", str(path), "--radec", "84,-1,0", "-o", str(tmp_path / "o.fits")],
    ):
        done = run_hilstar_here(*words)
        assert done.returncode == 0
        assert "the f-number" in done.stderr


@pytest.mark.parametrize("port", ["/dev/ttyUSB99", "/dev/serial/by-id/gone"])
def test_a_serial_port_that_is_not_there_is_the_machine_s(port: str, tmp_path: Path) -> None:
    for table in (
        f'[attitude]\nsource = "serial"\nport = "{port}"\n',
        f'[sync]\nport = "{port}"\n',
    ):
        path = tmp_path / "bench.toml"
        text = DEMO.read_text()
        path.write_text(
            text[: text.index("[attitude]")] + table if "[attitude]" in text else text + table
        )
        done = run_hilstar_here("serve", str(path), "--headless", "--duration", "1")
        assert done.returncode == 3, done.stderr
        assert "no such device; plug it in" in done.stderr
    log = tmp_path / "log.csv"
    log.write_text("t_s,qw,qx,qy,qz\n0,1,0,0,0\n1,1,0,0,0\n")
    done = run_hilstar_here("send", str(log), "--to", f"serial:{port}")
    assert done.returncode == 3


def test_a_display_that_does_not_answer_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    from hilstar.display.window.window import displays

    monkeypatch.setenv("DISPLAY", ":9973")
    with pytest.raises(MachineError, match="DISPLAY=:9973: no X server answers there"):
        displays()
    monkeypatch.delenv("DISPLAY")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(MachineError, match="set DISPLAY"):
        displays()


def test_certify_finds_the_example_of_the_truth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = run_hilstar_here(
        "certify", "gone.toml", "--virtual", "truth-example.toml", "-o", "certificate"
    )
    assert "gone.toml" in done.stderr
    from hilstar.cli.image_source import ImageOptions

    example = ImageOptions(virtual=Path("truth-example.toml")).truth()
    assert example is not None
    assert example.is_file()
    assert ImageOptions(virtual=Path("other.toml")).truth() == Path("other.toml")


def test_doctor_keeps_a_long_name_apart_from_its_text() -> None:
    from hilstar.server.bench.cameras import bench_camera
    from hilstar.server.bench.measured_on import MonitorCheck
    from hilstar.server.bench.star_size import star_size

    file = read_bench_file(DEMO)
    star = star_size(file.config, file.folder, bench_camera(file.config, file.folder))
    report = BenchReport(fields_of_view(file.config, file.folder), star, MonitorCheck(None))
    line = next(report.lines("truth-example.toml"))
    assert "truth-example.toml screen" in line


def test_the_size_of_a_screen_is_looked_at_by_itself() -> None:
    class Wide:
        size_px = (1920, 1080)

    monitor = read_bench_file(DEMO).config.monitor
    fault = size_fault(Wide(), monitor)  # type: ignore[arg-type]
    width, height = monitor.resolution_px
    expected = (
        ""
        if (width, height) == (1920, 1080)
        else f"1920 x 1080 px and the bench file says {width} x {height}"
    )
    assert expected in fault
    assert bool(fault) == bool(expected)
