"""A bag of messages, as an MCAP of ROS 2."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from tests.support.sources.ros_bags import Sent, write_mcap


@pytest.fixture
def bag(tmp_path: Path) -> Callable[[Iterable[Sent]], Path]:
    return lambda sent: write_mcap(tmp_path / "a.mcap", sent, "jazzy")
