"""The demo has the operator's page too."""

from __future__ import annotations

import subprocess

import pytest

from tests.support.commands import HILSTAR
from tests.support.pages import live, page_of, picture_of
from tests.support.servers import Served

pytestmark = pytest.mark.e2e


def test_the_demo_can_be_watched_and_acted_on(tmp_path):
    command = [*HILSTAR, "demo", "-o", str(tmp_path / "demo"), "--duration", "60", "--console", "127.0.0.1:0", "--control"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            page = page_of(Served(process, 0))
            with live(page) as link:
                hello = link.await_message(lambda said: isinstance(said, dict) and "hello" in said)["hello"]
                link.want(picture=True, hz=8)
                head, levels = picture_of(link.await_message(lambda said: isinstance(said, bytes)))
            assert hello["command"] == "hilstar demo" and hello["control"]
            assert levels.shape == (head["h"], head["w"]) == tuple(reversed(hello["resolution_px"]))
            assert page.control("mark", "Ada", text="the demo runs")[0] == 200
        finally:
            process.terminate()
            process.communicate()
