"""Opens the page of a run: one call for the commands."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from hilstar.console.feed.board import Board
from hilstar.console.feed.door import Door
from hilstar.console.feed.feed import Feed
from hilstar.console.feed.host import Host
from hilstar.console.feed.introduction import Told, introduced
from hilstar.console.feed.messages import Setup
from hilstar.console.feed.orders import Orders
from hilstar.console.feed.seen import Watched
from hilstar.console.feed.staging import scene_of
from hilstar.run.operator import SwitchRequests

if TYPE_CHECKING:
    from hilstar.bench.faults.desk import FaultDesk
    from hilstar.bench.frame import Bench
    from hilstar.notices import Notices
    from hilstar.run.record.ledger import Ledger
    from hilstar.run.record.ledger_switch import LedgerSwitch
    from hilstar.run.screen.screen import Screen


@dataclass(frozen=True, slots=True)
class Parts:
    """What a run is made of; `make_ledger` begins one at a path."""

    bench: Bench
    notices: Notices
    ledger: LedgerSwitch
    make_ledger: Callable[[Path], Ledger]
    screen: Screen | None = None
    faults: FaultDesk | None = None


@contextmanager
def opened_page(door: Door, control: bool, told: Told, parts: Parts) -> Iterator[tuple[Feed, SwitchRequests]]:
    """The page of a run while this is open: what frames are given to, and where its wishes come from."""
    width, height = parts.bench.config.monitor.resolution_px
    picture_bytes = width * height * (1 if parts.bench.calibration.response.white < 2**8 else 2)
    board = Board.make(picture_bytes)
    feed, requests = Feed(board), SwitchRequests()
    watched = Watched(feed, parts.notices, parts.ledger, parts.screen, parts.faults)
    orders = Orders(requests, watched, parts.make_ledger)
    with Host(setup_of(door, control, told, parts, picture_bytes), board, door.socket, watched, orders.do):
        yield feed, requests


def setup_of(door: Door, control: bool, told: Told, parts: Parts, picture_bytes: int) -> Setup:
    """What the page's process is told at its start."""
    bench = parts.bench
    setup = introduced(door, control, told, bench.file, picture_bytes)
    setup.hello |= {
        "renderer": bench.renderer.gl_renderer,
        "white_level": bench.calibration.response.white,
        "faults": [] if parts.faults is None else parts.faults.names(),
    }
    setup.scene = pickle.dumps(scene_of(bench, aids_in_levels=parts.screen is None))
    return setup
