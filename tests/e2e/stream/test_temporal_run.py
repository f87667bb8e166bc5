"""`temporal`, whose frames hang on those before them: a live run's ledger gives its codes again,
whatever the run missed.
"""

from __future__ import annotations

import threading

import numpy as np

from hilstar.attitude.wire.endpoint import AllowedSenders, bound_place
from hilstar.attitude.wire.udp import UdpLink
from hilstar.basics.notices import Notices
from hilstar.server.bench.build import load
from hilstar.server.loop import Limit
from hilstar.server.record.ledger import Ledger, LedgerSwitch
from hilstar.server.replay import Wanted, plan_play, replay
from hilstar.server.send_log import BadCable, Faults, send, spin_samples
from hilstar.server.sender import UdpSender
from hilstar.server.serve import Outlet, serve
from tests.support.benches import bench_text
from tests.support.senders import free_port

START_DEG = (84.057, -1.2, 0.0)
RATE_RAD_S = np.radians([0.0, 0.5, 3.0])
FRAMES = 60
SHARED = 1e-3  # of pixels where codes differ: two paths may share one


def test_a_live_run_is_replayed_from_its_ledger_code_for_code_and_from_its_middle_in_light(
    tmp_path,
):
    """Stars come and go at the edges, and the first frames are blank: no attitude has come."""
    path, port, ledger = tmp_path / "bench.toml", free_port(), tmp_path / "run.mcap"
    render = {"quantisation": "temporal", "motion": "on"}
    path.write_text(bench_text({"attitude": {"source": "udp", "port": port}, "render": render}))
    codes, again, later = {}, {}, {}

    def into(kept):
        return lambda shown: kept.update({shown.number: shown.drawn.levels.copy()})

    with load(path) as bench:
        notices, stop = Notices(), threading.Event()
        kept = LedgerSwitch(Ledger(ledger, bench, notices))
        with (
            UdpLink(bound_place(None, port, None), AllowedSenders(), notices) as link,
            UdpSender(link.endpoint) as road,
        ):
            cable = BadCable(Faults(), np.random.default_rng(1), road.put)
            sender = threading.Thread(
                target=send, args=(cable, spin_samples(RATE_RAD_S, 100.0, START_DEG), stop)
            )
            threading.Timer(0.1, sender.start).start()
            serve(
                bench, link, Limit(frames=FRAMES), into(codes), Outlet(ledger=kept, notices=notices)
            )
            stop.set()
            sender.join()
        kept.end()
        replay(bench, plan_play(ledger, Wanted(speed=float("inf")), bench.config), into(again))
        replay(
            bench,
            plan_play(ledger, Wanted(speed=float("inf"), start_s=0.5), bench.config),
            into(later),
        )
    assert codes.keys() == again.keys() and len(codes) == FRAMES
    assert all(np.array_equal(codes[number], again[number]) for number in codes)
    assert max(levels.max() for levels in codes.values()) > 0
    assert later.keys() < codes.keys()
    # From the middle stars begin anew: other codes about the same light, all but a few within a
    # level.
    apart = np.concatenate(
        [
            np.abs(codes[number].astype(int) - later[number])[codes[number] != later[number]]
            for number in later
        ]
    )
    assert len(apart) > 100
    assert np.mean(apart > 1) < SHARED
