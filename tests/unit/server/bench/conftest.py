"""A bench with a strongly bent lens."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from hilstar.server.bench.build import load
from hilstar.server.bench.frame import Bench
from tests.support.real_lens import write_lens_bench


@pytest.fixture(scope="module")
def lens_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its files."""
    folder = tmp_path_factory.mktemp("lens")
    write_lens_bench(folder)
    return folder


@pytest.fixture(scope="module")
def lens_bench(lens_folder: Path) -> Iterator[Bench]:
    """The bench itself."""
    with load(lens_folder / "bench.toml") as bench:
        yield bench
