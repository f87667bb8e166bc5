"""An X server for each module, and a bench file of its size with a log that stands still."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from hilstar.instruments.calibrate.first_light import image_sources
from tests.support.benches import SCREEN_BENCH, still_log
from tests.support.x11.screens import Screen, xvfb
from tests.support.x11.xorg import Xorg, xorg


@pytest.fixture(scope="module")
def screen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Screen]:
    """A screen of 640 x 480."""
    with xvfb(tmp_path_factory.mktemp("screen")) as running:
        yield running


@pytest.fixture
def screen_here(screen: Screen, monkeypatch: pytest.MonkeyPatch) -> Screen:
    """The screen as this process's own: one that has a pattern within moments, as no panel has."""
    monkeypatch.setenv("DISPLAY", screen.display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(image_sources, "SETTLE_S", 0.05)
    return screen


@pytest.fixture
def screen_file(tmp_path: Path) -> Path:
    """A bench whose monitor is the screen; `still.csv` beside it."""
    path = tmp_path / "bench.toml"
    path.write_text(SCREEN_BENCH)
    still_log(tmp_path / "still.csv")
    return path


@pytest.fixture(scope="module")
def server(tmp_path_factory) -> Iterator[Xorg]:
    with xorg(tmp_path_factory.mktemp("xorg")) as running:
        running.xrandr("--output", "DUMMY0", "--gamma", "1:1:1")
        yield running


@pytest.fixture
def here(server, monkeypatch) -> Xorg:
    """The server, as this process's own."""
    monkeypatch.setenv("DISPLAY", server.display)
    return server
