"""Tab completes commands, options and choices, in a real bash that was set up by `hilstar
--install-completion`.
"""

from __future__ import annotations

import os
import pty
import select
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

import hilstar

BASH = shutil.which("bash")
INSTALLED = Path(sys.executable).parent / "hilstar"
LIMIT_S = 120.0  # 300 times what one completion takes on an idle machine

pytestmark = pytest.mark.skipif(
    BASH is None or not INSTALLED.exists(), reason="no bash, or hilstar is not installed"
)


@pytest.fixture(scope="module")
def env(tmp_path_factory):
    """A user's environment, in whose home completion is installed from within a bash."""
    home = tmp_path_factory.mktemp("home")
    env = {
        "HOME": str(home),
        "PATH": f"{INSTALLED.parent}:{os.environ['PATH']}",
        "SHELL": str(BASH),
        "TERM": "dumb",
        "PS1": "$ ",
    }
    done = subprocess.run(
        [str(BASH), "--norc", "-c", "hilstar --install-completion; exit $?"],
        env=env,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "bash completion installed" in done.stdout
    return env


def typed(env, keys, wanted):
    """What an interactive bash shows once `keys` were typed into it, up to `wanted`."""
    process, terminal = pty.fork()
    if process == 0:
        os.execve(str(BASH), ["bash", "--rcfile", f"{env['HOME']}/.bashrc", "-i"], env)
    shown, until_s = "", time.monotonic() + LIMIT_S
    os.write(terminal, keys.encode())
    try:
        while wanted not in shown and time.monotonic() < until_s:
            if select.select([terminal], [], [], 1.0)[0]:
                shown += os.read(terminal, 4096).decode(errors="replace")
    finally:
        os.close(terminal)  # which ends the shell
        os.waitpid(process, 0)
    return shown


def test_tab_in_a_real_bash_completes_an_option_and_the_line_runs(env):
    assert f"hilstar {hilstar.__version__}" in typed(
        env, "hilstar --vers\t\n", f"hilstar {hilstar.__version__}"
    )


@pytest.mark.parametrize(
    ("line", "word"),
    [
        ("hilstar fr", "frame"),
        ("hilstar frame --ra", "--radec"),
        ("hilstar study ch", "chain"),
        ("hilstar calibrate geo", "geometric"),
        ("hilstar replay bench.toml log.csv --speed re", "realtime"),
        ("hilstar first-light bench.toml -o s --again photo", "photometry"),
        ("hilstar budget bench.toml --centroider win", "window"),
        ("hilstar tracker bench.toml --solver tet", "tetra3"),
        ("hilstar frame bench.toml --star Betel", "Betelgeuse"),
        ("hilstar help calibrate geo", "geometric"),
    ],
)
def test_bash_is_given_the_word(env, line, word):
    words = line.split()
    ask = (
        f"COMP_WORDS=({line}); COMP_CWORD={len(words) - 1}; _hilstar_completion hilstar; echo"
        " ${COMPREPLY[@]}"
    )
    done = subprocess.run(
        [str(BASH), "--norc", "-c", f"source ~/.bashrc; {ask}"],
        env=env,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=True,
    )
    assert done.stdout.split() == [word]


def test_zsh_gets_its_script(env):
    script = subprocess.run(
        [str(INSTALLED)],
        env=env | {"_HILSTAR_COMPLETE": "source_zsh"},
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=True,
    ).stdout
    assert "#compdef hilstar" in script
    asked = env | {"_HILSTAR_COMPLETE": "complete_zsh", "_TYPER_COMPLETE_ARGS": "hilstar fr"}
    done = subprocess.run(
        [str(INSTALLED)], env=asked, capture_output=True, text=True, timeout=LIMIT_S, check=True
    )
    assert '"frame"' in done.stdout


def test_completing_needs_no_numpy_and_a_command_no_pydantic():
    # Half of the time that Tab would take; 0.17 s of processor time without, 0.30 s with it. A
    # command: 0.33 and 0.44 s.
    code = (
        "import hilstar.cli, sys; print('numpy' in sys.modules); hilstar.cli.run_command(['frame',"
        " 'none.toml'])"
    )
    found = subprocess.run(
        [sys.executable, "-c", f"{code}; print('pydantic' in sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert found.stdout.split() == ["False", "False"]
