"""The page's picture is what the display shows, with what an operator lays over it from the
page.
"""

from __future__ import annotations

import subprocess

import numpy as np
import pytest

from tests.support.benches import SCREEN_BENCH, still_log
from tests.support.forks import HILSTAR, Started
from tests.support.pages import live, page_of, picture_of
from tests.support.servers import Served
from tests.support.waiting import wait_for

pytestmark = pytest.mark.screen


def test_the_page_s_picture_is_what_the_display_shows_under_every_aid(screen, tmp_path):
    bench = tmp_path / "bench.toml"
    bench.write_text(SCREEN_BENCH.replace('"exact"', '"round"'))
    command = [
        *HILSTAR,
        "replay",
        str(bench),
        str(still_log(tmp_path / "still.csv")),
        "--console",
        "127.0.0.1:0",
        "--control",
    ]
    with Started(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, env=screen.env
    ) as process:
        served = Served(process, 0)
        try:
            page = page_of(served)
            wait_for(lambda: page.health_is(True))
            seen = []
            with live(page) as link:
                link.want(picture=True, hz=10)

                def shown_anew() -> bool:
                    """Whether the page's next picture is what the screen shows, and not what it
                    showed before the switch.
                    """
                    _, levels = picture_of(link.await_message(lambda said: isinstance(said, bytes)))
                    if (seen and np.array_equal(seen[-1], levels)) or not np.array_equal(
                        screen.pixels()[:, :, 0], levels
                    ):
                        return False
                    seen.append(levels)
                    return True

                for switches in ((), ("crosshair",), ("grid",), ("patch",), ("blank",)):
                    for name in switches:
                        assert page.control(name, on=True, level=0.75)[0] == 200
                    wait_for(shown_anew, switches, poll_s=0.0)
            assert len(seen) == 5
        finally:
            process.kill()
