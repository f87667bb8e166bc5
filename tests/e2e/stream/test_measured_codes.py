"""What codes cost is measured where a clock paces a run, stands in its ledger, and decides
nowhere else.
"""

from __future__ import annotations

import json
import signal

from tests.support.benches import SMALL_BENCH, attitude_table, still_log
from tests.support.commands import HILSTAR, run_hilstar_here
from tests.support.ledgers import read_run
from tests.support.senders import await_subscriber_of, packet, publisher
from tests.support.servers import Run
from tests.support.waiting import PATIENCE_S

MEASURED, TABULATED = "as measured here ([render] codes_ms = [", "on two cores without a GPU"


def codes_line(stderr: str) -> str:
    """What --explain says of the codes."""
    return next(line for line in stderr.splitlines() if "codes: " in line)


def chosen_codes(stderr: str) -> str:
    """The quantisation in --explain's table."""
    return next(line for line in stderr.splitlines() if line.startswith("codes ")).split()[1]


def test_a_served_run_says_what_codes_cost_and_its_ledger_keeps_it(tmp_path):
    bench, ledger = tmp_path / "serve.toml", tmp_path / "run.mcap"
    with publisher() as (sender, port):
        bench.write_text(SMALL_BENCH + attitude_table(port))
        with Run(
            [*HILSTAR, "serve", str(bench), "--headless", "--ledger", str(ledger), "--explain"]
        ) as process:
            await_subscriber_of(port)
            sender.send(packet(0, 0, (0.5, 0.5, -0.5, 0.5), (0.0, 0.0, 0.0)))
            process.shows(10)
            process.send_signal(signal.SIGINT)
            _, said = process.communicate(timeout=PATIENCE_S)
    head = read_run(ledger).head
    cheap_ms, best_ms = json.loads(head["codes_ms"])
    explained = [
        run_hilstar_here(
            "replay", bench, ledger, "--headless", "--speed", speed, "--explain"
        ).stderr
        for speed in ("max", "realtime")
    ]
    framed = run_hilstar_here(
        "frame", bench, "--radec", "84,-1,0", "--truth", tmp_path / "t.csv", "--explain"
    ).stderr
    assert f"{MEASURED}{cheap_ms:g}, {best_ms:g}]" in codes_line(said)
    assert min(cheap_ms, best_ms) > 0
    assert head["quantisation"] in {"round", "exact"}
    # A replay chooses as the run did, whatever it would measure itself; another command by the
    # table.
    for text in explained:
        assert "by [render] codes_ms" in codes_line(text)
        assert chosen_codes(text) == head["quantisation"]
    assert TABULATED in codes_line(framed) and MEASURED not in framed


def test_a_log_is_timed_in_real_time_alone_and_not_where_a_key_says_it(tmp_path):
    bench, log = tmp_path / "bench.toml", still_log(tmp_path / "log.csv", 0.1)
    bench.write_text(SMALL_BENCH)
    kept = tmp_path / "kept.mcap"
    lines = [
        codes_line(
            run_hilstar_here(
                "replay", bench, log, "--headless", "--speed", speed, "--explain", *more
            ).stderr
        )
        for speed, more in (("realtime", ()), ("max", ("--ledger", kept)))
    ]
    assert MEASURED in lines[0] and TABULATED in lines[1]
    assert json.loads(read_run(kept).head["codes_ms"]) is None
    bench.write_text(SMALL_BENCH + "[render]\ncodes_ms = [1.5, 400]\n")
    for speed in ("realtime", "max"):
        text = run_hilstar_here(
            "replay", bench, log, "--headless", "--speed", speed, "--explain"
        ).stderr
        assert chosen_codes(text) == "round"
        assert "takes 400 ms of 16.7 (round 1.5)" in codes_line(text)
