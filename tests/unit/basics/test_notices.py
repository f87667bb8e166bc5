"""Events that last: begun once, ended once, and in the status as long."""

from __future__ import annotations

from hilstar.basics.notices import Notices


def test_an_event_that_lasts_is_told_when_it_begins_and_when_it_is_over():
    notices = Notices()
    for _ in range(3):
        notices.begin("source-frozen", "the sender's clock stands still")
    assert notices.active == {"source-frozen"}
    assert notices.counts() == {"source-frozen": 1}
    for _ in range(3):
        notices.end("source-frozen", "source-runs", "the sender's clock runs again")
    assert not notices.active
    assert notices.counts() == {"source-frozen": 1, "source-runs": 1}


def test_an_event_holds_text_whatever_a_file_in_it_is_called():
    notices, heard = Notices(), []
    notices.listen(heard.append)
    notices.tell("ledger-failed", "a\udcff.mcap: \x1b[31mred\nline", "who\ud800")
    assert heard[0].detail == r"a\xff.mcap: \x1b[31mred\x0aline"
    assert heard[0].who.encode()


def test_a_kind_that_comes_on_is_said_less_and_less_and_summed_up_at_the_end(caplog, monkeypatch):
    """Once a second for an hour: it was said three times each ten seconds, and recorded 3600
    times.
    """
    now_s = 1000.0
    monkeypatch.setattr("hilstar.basics.notices.time.monotonic_ns", lambda: round(now_s * 1e9))
    notices, heard = Notices(), []
    notices.listen(heard.append)
    for _ in range(3600):
        notices.tell("flood", "too many packets")
        now_s += 1.0
    assert notices.counts() == {"flood": 3600}
    lines = [line for line in caplog.messages if "too many packets" in line]
    assert 5 < len(lines) < 15
    assert "only counted for 10 s" in lines[2]
    assert "only counted for 20 s" in lines[3]
    assert "(9 more meanwhile)" in lines[3]
    assert "only counted for 640 s" in lines[-1]
    assert len(heard) < 40
    notices.sum_up()
    assert "events in all: flood 3600 (" in caplog.messages[-1]
    now_s += 3600.0
    notices.tell("flood", "too many packets")
    assert caplog.messages[-1].endswith("too many packets")


def test_what_a_person_did_is_recorded_however_often():
    notices, heard = Notices(), []
    notices.listen(heard.append)
    for k in range(100):
        notices.tell("mark", f"mark {k}", "somebody")
    assert len(heard) == 100
