"""Each limit that a page states to a user is the program's own, and no other."""

from __future__ import annotations

import pytest

from hilstar.basics.units import NS_PER_S
from hilstar.cli.service import UNIT
from hilstar.server import faults
from hilstar.server.answers import formats, judge, reader
from hilstar.server.bench.scenario import MAX_ON, MAX_SURFACES_ON
from hilstar.server.console import publisher, scpi
from hilstar.server.console.server import app, connections, scpi_server
from hilstar.server.console.server import reader as page_reader
from hilstar.server.gige import registers
from hilstar.server.record.ledger import FRAMES_RESERVE_BYTES, LOW_SHARE, FloodFilter
from hilstar.server.screen.gate import GATE_FRAMES
from tests.support.benches import ROOT

SPELT = {0.1: "a tenth", 3: "three", 5: "Five", 10: "Ten", 16: "Sixteen", 50: "fifty"}
KB = 1000
LIMITS = [
    ("scpi", "a queue of {} errors", scpi.MAX_ERRORS),
    ("scpi", "a line of more than {} bytes", scpi.MAX_LINE_BYTES),
    ("scpi", "that no frame shows within {} s is error -365", scpi_server.SETTLES_NS / NS_PER_S),
    ("scpi", "{} of each are served", scpi_server.MAX_CONTROLLERS),
    ("scpi", "{} of each are served", scpi_server.MAX_STRANGERS),
    ("scpi", "A controller has {} lines a turn", scpi_server.UNITS_A_TURN),
    (
        "scpi",
        "all strangers together {} a second",
        scpi_server.STRANGER_UNITS_A_TURN / scpi_server.STRANGERS_S,
    ),
    ("scpi", "{} wrong tokens close the connection", scpi_server.MAX_WRONG_TOKENS),
    ("console", "| 413, 415 | over {} bytes", app.MAX_BODY_BYTES),
    ("console", "| 504 | not taken within {} s", publisher.LOOP_WAITS_S),
    ("console", "no frame asked for in {} s", page_reader.UNASKED_NS / NS_PER_S),
    ("console", "no frame within {} s or", page_reader.HUNG_NS / NS_PER_S),
    ("console", "s or {} refresh periods", page_reader.HUNG_PERIODS),
    ("console", "nothing at all for {} s", page_reader.SILENT_NS / NS_PER_S),
    ("console", "with `[answers]`: for {} s", judge.SILENT_S),
    ("console", "times as long as between its answers; {} s at the start", judge.FIRST_S),
    ("console", "A head has {} s to come", connections.HEAD_S),
    ("console", "a body {} s and", app.BODY_S),
    ("console", "s and {} bytes. Of", app.MAX_BODY_BYTES),
    ("console", "Of {} connections those already answered", connections.MAX_CONNECTIONS),
    ("console", "{} pages may be open", connections.MAX_CLIENTS),
    ("console", "Pages are pinged every {} s", connections.PING_S),
    ("console", "closed after {} s without an answer", connections.PONG_S),
    ("console", "or over {} messages in", connections.MAX_WISHES),
    ("console", "messages in {} s closes the WebSocket", connections.WISHES_S),
    ("faults", "{} a second are taken", faults.MAX_PER_S),
    ("faults", "a second are taken, {} at once", faults.MAX_BURST),
    ("faults", "at once, of {} kB", faults.MAX_MESSAGE_BYTES / 1024),
    ("faults", "{} faults are on at most", MAX_ON),
    ("faults", "on at most, {} of them stray light", MAX_SURFACES_ON),
    ("answers", "while it has sent within {} s", reader.HELD_S),
    ("answers", "It takes at most {} kB", reader.MAX_BYTES_PER_S / KB),
    ("answers", "kB and {} answers a second. A process", reader.MAX_ANSWERS_PER_S),
    ("answers", "({} sigma, at most", judge.SURE),
    ("answers", "sigma, at most {} s, times the rate", judge.MAX_EXCUSED_S),
    ("answers", "A mode is cut to {} characters", formats.MAX_MODE_CHARACTERS),
    ("camera", "| 10 us to {} s;", registers.MAX_EXPOSURE_US / 1e6),
    ("camera", "| {} us to 60 s;", registers.MIN_EXPOSURE_US),
    ("camera", "| 0 to {} dB over", registers.MAX_GAIN_DB),
    ("camera", "A client that is silent for {} s", registers.DEFAULT_HEARTBEAT_MS / 1000),
    ("on-time", "as are good ones over {} a second", FloodFilter.ALLOWED["accepted"][1]),
    ("on-time", "(a fiftieth, {} MB at most)", FRAMES_RESERVE_BYTES / 1e6),
    ("on-time", "At {} there is a warning", LOW_SHARE),
    ("first-day", "`serve` first measures {} frames", GATE_FRAMES),
]


@pytest.mark.parametrize(("page", "words", "limit"), LIMITS, ids=lambda part: str(part)[:24])
def test_a_limit_that_a_page_states_is_the_programs(page: str, words: str, limit: float):
    text = " ".join((ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8").split())
    spelt = words.format(SPELT.get(limit, ""))
    assert words.format(f"{limit:g}") in text or (limit in SPELT and spelt in text)


def test_the_watchdog_of_the_unit_is_the_one_that_the_page_states():
    page = (ROOT / "docs" / "console.md").read_text(encoding="utf-8")
    assert "One that hangs for 3 s is killed" in page and "started again after 0.2 s" in page
    assert "WatchdogSec=3\n" in UNIT and "RestartSec=200ms\n" in UNIT
