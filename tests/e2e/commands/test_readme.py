"""The README is true: its first command, its sender, its bench file, its Python and its picture."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from tests.support.benches import ROOT
from tests.support.commands import run_hilstar, run_hilstar_here

README = (ROOT / "README.md").read_text()
FILES = ("pyproject.toml", "README.md", "LICENSE", "hilstar", "shaders", "configs")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\b[^\n]*\n(.*?)```", README, re.DOTALL)


def shape(text: str) -> str:
    """The lines with every figure and name that differs from machine to machine made alike."""
    text = re.sub(r"(?m)^renderer .*$", "renderer", text)
    return re.sub(r"-?\d+(\.\d+)?", "N", text)


def test_the_first_command_does_the_main_job_in_a_fresh_checkout(tmp_path):
    """As it stands: apt, a new environment, a wheel, and the demo, in a folder that has only what git has."""
    for name in FILES:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, tmp_path / name)
    clean = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}
    result = subprocess.run(
        ["sh", "-c", blocks("sh")[0]], cwd=tmp_path, capture_output=True, text=True, timeout=600, check=False, env=clean,
        stdin=subprocess.DEVNULL,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    printed = result.stdout[result.stdout.index("frames  ") :]
    assert shape(printed) == shape(blocks("text")[0])
    assert len(list((tmp_path / "hilstar-demo").glob("frame_*_codes.png"))) == 4


def test_the_picture_is_what_the_program_makes(tmp_path):
    script = [sys.executable, ROOT / "docs" / "make_picture.py", tmp_path / "p.png"]
    made = subprocess.run(script, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    ours, theirs = (np.array(Image.open(path).convert("L")).astype(int) for path in (tmp_path / "p.png", ROOT / "readme.png"))
    assert ours.shape == theirs.shape
    # Another driver may round a code the other way: the preview's power of 0.35 makes at most 40 grey levels of one, and a code
    # that is written out differs in a hundred pixels of a million. Another field differs in 5000.
    assert (np.abs(ours - theirs) > 40).mean() < 1e-3


def test_the_sender_is_heard(tmp_path):
    sender = blocks("python")[0].replace(":5560", ":5571")
    (tmp_path / "bench.toml").write_text(blocks("toml")[0] + '[attitude]\nendpoint = "tcp://127.0.0.1:5571"\n')
    with subprocess.Popen([sys.executable, "-c", sender]) as process:
        try:
            result = run_hilstar("serve", "bench.toml", "--headless", "--duration", "2", cwd=tmp_path)
        finally:
            process.kill()
    assert result.returncode == 0, result.stderr
    heard = re.search(r"packets +(\d+) received, 0 refused", result.stdout)
    assert heard is not None
    assert int(heard[1]) > 100


def test_the_user_s_regression_test_passes(tmp_path):
    (tmp_path / "bench.toml").write_text(blocks("toml")[0])
    (tmp_path / "test_mine.py").write_text(blocks("python")[1])
    assert blocks("python")[1].strip().count("\n") + 1 <= 9
    result = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "test_mine.py"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stdout


@pytest.mark.parametrize("command", sorted(set(re.findall(r"(?m)^hilstar (\w+) ", blocks("text")[2]))))
def test_every_command_of_the_readme_is_there(command):
    result = run_hilstar_here(command, "--help")
    assert result.returncode == 0, result.stderr


def test_the_installed_wheel_runs_the_demo_from_elsewhere(tmp_path):
    """Shaders, configs and data are inside the wheel: nothing of the checkout is used."""
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--outdir", tmp_path / "dist", ROOT], check=True, capture_output=True
    )
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "env"], check=True)
    python = tmp_path / "env" / "bin" / "python"
    subprocess.run([python, "-m", "pip", "install", "-q", wheel], check=True, capture_output=True, timeout=600)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    command = [tmp_path / "env" / "bin" / "hilstar", "demo", "--duration", "2", "--json"]
    clean = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    result = subprocess.run(command, cwd=elsewhere, capture_output=True, text=True, timeout=120, check=False, env=clean)
    assert result.returncode == 0, result.stderr
    assert '"frames":1' in result.stdout
    assert len(list((elsewhere / "hilstar-demo").glob("*_codes.png"))) == 4
    where = subprocess.run(
        [python, "-c", "import hilstar; print(hilstar.__file__)"],
        cwd=elsewhere,
        capture_output=True,
        text=True,
        check=True,
        env=clean,
    )
    assert str(tmp_path / "env") in where.stdout


def test_a_row_that_justifies_a_default_is_there():
    """Comments in the code that name a row of the results: the file and the step exist."""
    steps = (ROOT / "results" / "tradeoff.csv").read_text()
    found = 0
    for path in [*(ROOT / "hilstar").rglob("*.py"), *(ROOT / "shaders").rglob("*.frag")]:
        for file, step in re.findall(r"results/(\w+\.csv)(?:, (\w+))?:", path.read_text()):
            assert (ROOT / "results" / file).exists()
            assert not step or f"\n{step}," in steps
            found += 1
    assert found >= 8
