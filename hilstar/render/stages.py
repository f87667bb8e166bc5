"""A renderer that keeps the time of each stage of a frame, for the benchmark alone: it waits where the other would not."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from hilstar.monitor.photometry import Codes
from hilstar.render.renderer import Renderer, Target
from hilstar.scene.sprites import Sprites

NS_PER_MS = 1e6


class StagedRenderer(Renderer):
    """A Renderer whose `stage_ms` holds the last frame's stages: upload, splat, encode and read_back in ms by the wall.

    `gpu_splat` and `gpu_encode` are the same by the driver's own timers, where it has them.
    """

    def __init__(self, target: Target) -> None:
        super().__init__(target)
        self.stage_ms: dict[str, float] = {}
        self._encoding = ExitStack()
        with self._ctx:
            self._queries = {stage: self._ctx.query(time=True) for stage in ("splat", "encode")}

    def draw(self, sprites: Sprites | None, frame: int = 0) -> None:
        """As Renderer.draw, each stage waited for."""
        super().draw(sprites, frame)
        with self._ctx:
            self._encoding.close()

    def codes(self) -> Codes:
        """As Renderer.codes."""
        begin = time.perf_counter()
        codes = super().codes()
        self.stage_ms["read_back"] = (time.perf_counter() - begin) * 1e3
        return codes

    def _upload(self, sprites: Sprites) -> None:
        with self._timed("upload"):
            super()._upload(sprites)

    def _draw_linear(self, count: int) -> None:
        with self._timed("splat"):
            super()._draw_linear(count)
        # What draw does after this is the encoding.
        self._encoding.enter_context(self._timed("encode"))

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        query = self._queries.get(stage)
        begin = time.perf_counter()
        if query is None:
            yield
        else:
            with query:
                yield
        self._ctx.finish()
        self.stage_ms[stage] = (time.perf_counter() - begin) * 1e3
        if query is not None and query.elapsed:
            self.stage_ms[f"gpu_{stage}"] = query.elapsed / NS_PER_MS
