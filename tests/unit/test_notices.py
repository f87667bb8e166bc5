"""Events that last: begun once, ended once, and in the status as long."""

from __future__ import annotations

from hilstar.notices import Notices


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
