"""What the pages say to type is typed, and prints what they say it prints."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hilstar.cli.app import run
from hilstar.cli.options import with_values
from hilstar.instruments.campaign.plan import parse_plan
from hilstar.server.bench.config import read_config
from hilstar.server.bench.scenario import parse_scenario
from tests.docs.pages import Block, blocks_of, differs
from tests.support.benches import ROOT, SMALL_BENCH
from tests.support.commands import run_started
from tests.support.forks import Started
from tests.support.readme import plain_pytest
from tests.support.senders import free_port
from tests.support.servers import until_said
from tests.support.waiting import wait_for

DOCS = sorted((ROOT / "docs").glob("*.md"))
PAGES = [
    *DOCS,
    ROOT / "README.md",
    ROOT / "configs" / "README.md",
    ROOT / "configs" / "CALIBRATION.md",
]
PAGES += [ROOT / "firmware_protocol" / "README.md", ROOT / "CONTRIBUTING.md"]
EXAMPLES = {page: blocks for page in PAGES if (blocks := blocks_of(page.read_text()))}
# no other shell's name: a console block is run
LANGUAGES = {"console", "python", "toml", "json", "text", "c"}
# of the attitude, a run's frames, a tracker's answers, and the operator's page
DEFAULT_PORTS = ("5560", "5570", "5580", "8765")
LISTEN = "0A"  # a state of /proc/net/tcp
# Of a live run whose figures vary: ten seconds have the same lines, and hold a worker up.
MAX_DURATION_S = 2.0
# Of one whose ledger is assessed: 80 frames, of which 30 have to be answered.
MAX_ASSESSED_S = 8.0
TRACKER_LISTENS = "waiting for frames"

Ports = dict[str, str]


@pytest.fixture
def ports() -> Ports:
    """A free port in the place of each default one, so that pages may be tested side by side."""
    return {default: str(free_port()) for default in DEFAULT_PORTS}


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """The reader's folder: a page's files and outputs share it."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.e2e
@pytest.mark.usefixtures("without_charts")
@pytest.mark.parametrize("page", EXAMPLES, ids=[str(page.relative_to(ROOT)) for page in EXAMPLES])
def test_the_examples_do_what_the_page_says(page, folder, ports):
    names: dict[str, Any] = {"__name__": "__main__"}
    for block in EXAMPLES[page]:
        try:
            follow(block, folder, ports, names)
        except BaseException as error:
            error.add_note(f"{page.relative_to(ROOT)}:{block.line}")
            raise


def follow(block: Block, folder: Path, ports: Ports, names: dict[str, Any]) -> None:
    """Do with a block what its reader does."""
    if block.title is not None:
        (folder / block.title).write_text(file_text(block, ports))
    if block.not_run is not None:
        return
    if block.language == "console":
        type_in(block, ports)
    elif block.language == "python" and block.title is None:
        exec(compile(with_ports(block.text, ports), f"line {block.line}", "exec"), names)
    elif block.language == "toml":
        read_toml(block.text, folder)
    elif block.language == "json":
        json.loads(block.text)


def with_ports(text: str, ports: Ports) -> str:
    """A text with the page's own ports in the place of the default ones."""
    for default, port in ports.items():
        text = text.replace(f":{default}", f":{port}")
    return text


def file_text(block: Block, ports: Ports) -> str:
    """The text of a file; a bench file listens on the page's own port."""
    text = with_ports(block.text, ports)
    is_bench = (block.title or "").endswith(".toml") and "[monitor]" in text
    if is_bench and "[attitude]" not in text:
        text += f'[attitude]\nendpoint = "tcp://127.0.0.1:{ports["5560"]}"\n'
    return text


def read_toml(text: str, folder: Path) -> None:
    """Read tables of a bench file; those that the page leaves out are the small bench's."""
    given = set(re.findall(r"(?m)^\[(\w+)\]$", text))
    if "calibration" in given:  # of a calibration file
        return
    if "[[fault]]" in text:
        parse_scenario(folder / "scenario.toml", text)
        return
    if text.startswith("bench = "):  # a campaign's plan
        parse_plan(folder / "plan.toml", text)
        return
    if "[[clause]]" in text:  # an acceptance's, which its command reads
        return
    missing = [
        part
        for part in re.split(r"\n(?=\[)", SMALL_BENCH)
        if part.strip("\n[").split("]")[0] not in given
    ]
    path = folder / "tables.toml"
    path.write_text("\n".join([*missing, text]))
    read_config(path)


def type_in(block: Block, ports: Ports) -> None:
    """Run the commands of a console block and compare what they print."""
    port = ports["5560"]
    with contextlib.ExitStack() as beside:
        for step in block.steps:
            words = shlex.split(with_ports(step.command, ports))
            if words[:2] == ["hilstar", "send"] and "--to" not in words:
                words += ["--to", f"tcp://127.0.0.1:{port}"]
            if words[0] == "hilstar" and words[-1] == "--console":
                words.append(f"127.0.0.1:{ports['8765']}")
            if block.figures_vary and "--duration" in words:
                at = words.index("--duration") + 1
                # a run that a tracker is fed from is assessed
                longest_s = MAX_ASSESSED_S if "--feed" in words else MAX_DURATION_S
                words[at] = str(min(float(words[at]), longest_s))
            # each worker is a process, which takes a second to start
            if words[:2] in (["hilstar", "campaign"], ["hilstar", "accept"]):
                words += ["--workers", "1"]
            if step.beside:
                beside.enter_context(running(words))
                if words[:2] == ["hilstar", "send"]:  # a busy machine takes seconds to start it
                    wait_for(lambda: listens(int(port)), f"$ {step.command}")
                continue
            printed = hilstar(words[1:]) if words[0] == "hilstar" else other_program(words)
            if step.printed:
                difference = differs(step.printed, printed, block.figures_vary)
                assert difference is None, f"$ {step.command}\n{difference}; it prints\n{printed}"


def hilstar(words: list[str]) -> str:
    """What a hilstar command prints; it is run in this process, which saves a start of half a
    second.
    """
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        code = run(with_values(words))
    assert not code, f"exit code {code}: hilstar {' '.join(words)}"
    return printed.getvalue()


def other_program(words: list[str]) -> str:
    """What another program prints; `python` is this one."""
    command = [sys.executable, *words[1:]] if words[0] == "python" else words
    ended = run_started(command, env=plain_pytest(Path()))
    assert ended.returncode == 0, (shlex.join(words), ended.stdout, ended.stderr)
    return ended.stdout


@contextlib.contextmanager
def running(words: list[str]) -> Iterator[None]:
    """A hilstar command, or a script of the page's, beside the others until the block is done; a
    tracker, which imports its solver first, from when it sees frames.
    """
    command = words[1:] if words[0] == "python" else ["-m", *words]
    is_tracker = words[:2] == ["hilstar", "tracker"]
    err = subprocess.PIPE if is_tracker else None
    streams = {"stdout": subprocess.DEVNULL, "stderr": err}
    with Started([sys.executable, *command], text=True, **streams) as process:
        try:
            if is_tracker:
                until_said(process, TRACKER_LISTENS)
            yield
        finally:
            process.send_signal(signal.SIGTERM)


def listens(port: int) -> bool:
    """Whether somebody listens on a port of this machine; to connect would be to be taken for a
    listener.
    """
    lines = Path("/proc/net/tcp").read_text().splitlines()[1:]
    return any(
        line.split()[1].endswith(f":{port:04X}") and line.split()[3] == LISTEN for line in lines
    )


def test_what_is_not_run_says_why():
    for page, blocks in EXAMPLES.items():
        for block in blocks:
            assert block.not_run is None or len(block.not_run) > 10, (
                f"{page}:{block.line} gives no reason"
            )


@pytest.mark.parametrize("page", DOCS, ids=[page.name for page in DOCS])
def test_a_block_of_the_documentation_is_of_a_language_that_is_tested(page):
    for block in blocks_of(page.read_text()):
        assert block.language in LANGUAGES, f"{page}:{block.line}"


def test_most_console_blocks_are_run():
    blocks = [
        block for found in EXAMPLES.values() for block in found if block.language == "console"
    ]
    assert len(blocks) > 15
    assert sum(block.not_run is None for block in blocks) > len(blocks) / 2


@pytest.mark.parametrize(
    ("shown", "printed", "same"),
    [
        ("3 stars\n", "3 stars\n", True),
        ("3 stars\n", "4 stars\n", False),
        ("0.100 mag\n", "0.1004 mag\n", True),
        ("0.100 mag\n", "0.102 mag\n", False),
        ("a\n...\nd\n", "a\nb\nc\nd\n", True),
        ("a\n...\nd\n", "a\nb\nc\n", False),
        ("a\n", "a\nb\n", False),
        ("python ... (64 bits)\n", "python 3.13 (64 bits)\n", True),
        ("Python 3.11.7, ok\n", "Python 3.11.2, ok\n", False),
        ("Python 3.11.7, ok\n", "Python 3.11.7, ok\n", True),
    ],
)
def test_output_is_compared_by_line_and_figure(shown, printed, same):
    assert (differs(shown, printed, figures_vary=False) is None) == same


@pytest.mark.parametrize(
    ("shown", "printed", "same"),
    [
        ("Python 3.11.7, .../bin/python\n", "Python 3.11.2, /usr/bin/python\n", True),
        ("Python 3.11.7, .../bin/python\n", "Python 3.14.0, /usr/bin/python\n", True),
        ("llvmpipe (LLVM 15.0.6, 256 bits)\n", "llvmpipe (LLVM 19.1.7, 512 bits)\n", True),
        ("ZeroMQ 4.3.5, message in 0.39 ms\n", "ZeroMQ 4.3, message in 1.2 ms\n", True),
        ("Python 3.11.7\n", "Python none\n", False),
    ],
)
def test_where_figures_vary_a_version_is_one_figure(shown, printed, same):
    assert (differs(shown, printed, figures_vary=True) is None) == same
