"""The cases of a campaign before a real tracker, as the command shows them: what opens the display,
what the page hears of the time left, and what is said of a run that a signal ended.
"""

from __future__ import annotations

from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from hilstar.cli import running
from hilstar.cli.campaign import show_cases
from hilstar.cli.running import DisplayOptions
from hilstar.instruments.campaign.bench_run import OpenDisplay
from hilstar.instruments.campaign.run import Campaign
from hilstar.server.bench.build import open_bench
from tests.support.benches import bench_text
from tests.support.campaigns import plan_text
from tests.support.commands import run_hilstar_here

CASES = 8
FIELD = {"kind": "field", "radec_deg": [80.0, 20.0], "radius_deg": 1.5, "roll_deg": [0.0, 0.0]}


@pytest.mark.parametrize("is_whole", [True, False])
def test_cases_are_shown_on_one_display_and_the_page_hears_of_the_time_left(
    tmp_path, monkeypatch, capsys, is_whole
):
    answers = {"source": "udp", "bind": "127.0.0.1:5000", "format": "json"}
    (tmp_path / "bench.toml").write_text(bench_text({"answers": answers}))
    plan = tmp_path / "plan.toml"
    plan.write_text(plan_text(through="bench", cases=CASES, attitudes=FIELD))
    asked = DisplayOptions(headless=True, windowed=False, force=False, feed="tcp://127.0.0.1:1")
    page, sink, follower, feed = object(), object(), object(), object()
    directory, seen, told = object(), [], []
    now_s = 100.0

    @contextmanager
    def shown_bench(file, display, *, timed):
        assert display is asked and timed
        with open_bench(file) as bench:
            yield bench, None

    @contextmanager
    def optional_frames(endpoint, bench, screen):
        seen.append((endpoint, screen))
        yield feed

    @contextmanager
    def followed(listener, control, description, parts, status, *, frames):
        assert (listener, control, frames) == (page, False, feed)
        assert description.command == "campaign" and description.endpoint == str(plan)
        seen.append(parts.bench)
        yield sink, follower, None

    def show(this, where, opened, notices, on_done):
        nonlocal now_s
        assert where is directory
        notices.listen(lambda notice: told.append((notice.kind, notice.detail)))
        with opened(this.file) as display:
            assert display == OpenDisplay(seen[-1], None, sink, follower)
        # two were done before; what is counted beyond the cases is a check
        for at_s, done in ((101.0, 2), (111.0, 5), (112.0, 6), (125.0, 7), (140.0, CASES + 1)):
            now_s = at_s
            on_done(done)
        return is_whole

    monkeypatch.setattr(running, "shown_bench", shown_bench)
    monkeypatch.setattr(running, "optional_frames", optional_frames)
    monkeypatch.setattr(running, "followed", followed)
    monkeypatch.setattr(Campaign, "show", show)
    clock = SimpleNamespace(monotonic=lambda: now_s)
    monkeypatch.setattr("hilstar.cli.campaign.time", clock)
    campaign = Campaign(plan, tmp_path / "out", "centroids", 1.0, False)
    if is_whole:
        show_cases(campaign, directory, asked, page)
    else:
        with pytest.raises(KeyboardInterrupt):
            show_cases(campaign, directory, asked, page)
    assert seen[0] == ("tcp://127.0.0.1:1", None)
    # 3 of 6 in 11 s, 5 in 25 s, and all
    assert told == [
        ("campaign", "5 of 8 cases, 11 s left"),
        ("campaign", "7 of 8 cases, 5 s left"),
        ("campaign", "8 of 8 cases, 0 s left"),
    ]
    ended = f"hilstar: 8 of {CASES} cases are done; the same command goes on from there\n"
    assert capsys.readouterr().err.endswith(ended) is not is_whole


@pytest.mark.parametrize(
    ("through", "words", "of"),
    [
        *(
            ("bench", words, "tracker or display")
            for words in ("--workers 2", "--memory 1GB", "--images fits", "--solver truth")
        ),
        ("bench", "--scheduler tcp://127.0.0.1:1", "tracker or display"),
        *(
            ("tracker", words, "bench")
            for words in ("--headless", "--windowed", "--force", "--feed tcp://127.0.0.1:1")
        ),
        ("tracker", "--console", "bench"),
    ],
)
def test_what_means_nothing_for_a_plan_s_way_to_its_tracker_is_refused(
    tmp_path, through, words, of
):
    answers = {"source": "udp", "bind": "127.0.0.1:5000", "format": "json"}
    (tmp_path / "bench.toml").write_text(bench_text({"answers": answers}))
    plan = plan_text(through=through, cases=CASES, attitudes=FIELD)
    (tmp_path / "plan.toml").write_text(plan)
    done = run_hilstar_here("campaign", "plan.toml", "-o", "out", *words.split(), cwd=tmp_path)
    assert done.returncode == 2
    line = f"hilstar: campaign {words.split()[0]}: is for through = {of}; leave it out\n"
    assert done.stderr == line
    assert not (tmp_path / "out").exists()
