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


def test_after_a_rest_a_kind_is_said_as_at_first_and_with_how_many_there_were(caplog, monkeypatch):
    """Three within 10 s are said, the third with the time for which further ones are counted: 10 s,
    then 20 s where they come on. A rest of more than 10 s ends that. 20 of them are recorded, and
    what a person did besides.
    """
    now_s = [1000.0]
    monkeypatch.setattr("hilstar.basics.notices.time.monotonic_ns", lambda: round(now_s[0] * 1e9))
    notices, heard = Notices(), []
    notices.listen(heard.append)
    said = []
    for at_s in (0, 1, 2, 3, 4, 13, 14, 34, 60, 61, 62):
        now_s[0] = 1000.0 + at_s
        before = len(caplog.messages)
        notices.tell("flood", "many")
        for line in caplog.messages[before:]:
            said.append((at_s, line.partition("Z ")[2]))
    quiet = "; further ones are only counted for {} s"
    assert said == [
        (0, "many"),
        (1, "many"),
        (2, "many" + quiet.format(10)),
        (13, "many (2 more meanwhile)" + quiet.format(20)),
        (34, "many (1 more meanwhile)"),
        (60, "many"),
        (61, "many"),
        (62, "many" + quiet.format(10)),
    ]
    for _ in range(30):
        notices.tell("flood", "many")
    notices.tell("flood", "many", who="Ann")
    assert len(heard) == 20 + 1
    notices.sum_up()
    assert caplog.messages[-1].endswith("events in all: flood 42 (31 of them not said)")
    lines = len(caplog.messages)
    notices.sum_up()
    assert len(caplog.messages) == lines


def test_an_event_that_lasts_is_handed_on_with_when_it_began():
    notices, heard = Notices(), []
    notices.listen(heard.append)
    notices.begin("stale", "no packet", since_ns=123)
    notices.end("frozen", "runs", "never began")
    assert [(one.kind, one.detail, one.since_ns) for one in heard] == [("stale", "no packet", 123)]
