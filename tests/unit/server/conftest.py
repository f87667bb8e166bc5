"""What the tests of the server share: a loop over the small bench, of which nothing is drawn."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from hilstar.server.bench.build import load
from hilstar.server.bench.frame import Bench
from hilstar.server.loop import FrameLoop
from tests.support.benches import LIVE_BENCH


@pytest.fixture(scope="session")
def small_bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """The small bench, whose codes are `round`."""
    path = tmp_path_factory.mktemp("small") / "bench.toml"
    path.write_text(LIVE_BENCH)
    with load(path) as bench:
        yield bench


@pytest.fixture
def loop(small_bench: Bench) -> FrameLoop:
    """A loop of its own over the small bench, which has counted nothing yet."""
    return FrameLoop(small_bench)
