"""A renderer that times each stage of a frame, for the benchmark alone: unlike the renderer it waits after each stage."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from hilstar.monitor.response import Levels
from hilstar.render.renderer import Renderer, Target
from hilstar.units import NS_PER_MS


class StagedRenderer(Renderer):
    """A Renderer whose `stage_ms` holds the last frame's stages in ms of wall time: erase, upload, splat,
    encode, choose and read_back.

    `gpu_splat` and `gpu_encode` are the same by the driver's own timers, where it has them.
    """

    def __init__(self, target: Target) -> None:
        super().__init__(target)
        self.stage_ms: dict[str, float] = {}
        with self._ctx:
            self._queries = {stage: self._ctx.query(time=True) for stage in ("splat", "encode")}

    def levels(self) -> Levels:
        """As Renderer.codes."""
        begin = time.perf_counter()
        codes = super().levels()
        self.stage_ms["read_back"] = (time.perf_counter() - begin) * 1e3
        return codes

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        query = self._queries.get(name)
        begin = time.perf_counter()
        if query is None:
            yield
        else:
            with query:
                yield
        self._ctx.finish()
        self.stage_ms[name] = (time.perf_counter() - begin) * 1e3
        if query is not None and query.elapsed:
            self.stage_ms[f"gpu_{name}"] = query.elapsed / NS_PER_MS
