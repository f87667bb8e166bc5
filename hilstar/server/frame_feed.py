"""The frames of a run, handed to whoever watches (`--feed ENDPOINT`), off the frame loop's
critical path.

The loop copies a frame's levels into one of few buffers: 0.1 ms at 1080p, and nothing where nobody
watches. A thread finds the lit pixels and sends them. Where it has not done so with all buffers,
the frame is not handed on.
"""

import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.attitude.wire.shown_frames import FrameHead, FrameSender, ShownFrame
from hilstar.basics.process.closing import Closing
from hilstar.basics.rotation import propagate
from hilstar.basics.units import NS_PER_S
from hilstar.display.response import code_dtype
from hilstar.server.bench.frame import Bench
from hilstar.server.pacer import Shown

BUFFERS = 4
LOOK_S = 0.1  # between looks for new watchers while there is none
WORD_BYTES = 8


@dataclass(slots=True)
class _Copied:
    levels: npt.NDArray[np.unsignedinteger[Any]]
    head: FrameHead | None = None


class FrameFeed(Closing):
    """Hands on each frame that `see` is given, while somebody watches.

    `swap_to_light_ns` is the time from a swap to the middle row's light. Without a screen a frame
    is a sample at a moment (`FrameHead.moment_ns`).
    """

    def __init__(
        self, sender: FrameSender, bench: Bench, swap_to_light_ns: Callable[[], int] = lambda: 0
    ) -> None:
        self.sent = self.skipped = 0
        self.endpoint = sender.endpoint
        self._sender = sender
        self._bench = bench
        self._swap_to_light_ns = swap_to_light_ns
        self._rgb = bench.calibration.response.rgb
        self._free: queue.SimpleQueue[_Copied] = queue.SimpleQueue()
        self._full: queue.SimpleQueue[_Copied | None] = queue.SimpleQueue()
        self._made = 0
        self.watched = False
        self._half_period_ns = round(NS_PER_S / bench.config.monitor.refresh_hz / 2)
        self._half_hold_ns = round(bench.scan.hold_s * NS_PER_S / 2)
        self._before_ns: int | None = None  # the moment of the newest frame
        self._thread = threading.Thread(target=self._send, name="hilstar-frames", daemon=True)
        self._thread.start()

    def see(self, shown: Shown) -> None:
        """Take a frame. Called by the frame loop."""
        moment_ns = self._moment_ns(shown)
        before_ns = self._before_ns
        self._before_ns = moment_ns
        if not self.watched:
            return
        levels = shown.drawn.levels
        monitor = self._bench.config.monitor
        try:
            copied = self._free.get_nowait()
        except queue.Empty:
            if self._made == BUFFERS:
                self.skipped += 1
                return
            self._made += 1
            copied = _Copied(np.empty_like(levels))
        np.copyto(copied.levels, levels)
        if moment_ns is None:
            lit_ns = shown.swap_ns + self._swap_to_light_ns()
        elif before_ns is None or not shown.fades:
            lit_ns = moment_ns - self._half_period_ns
        else:
            lit_ns = (before_ns + moment_ns) // 2
        copied.head = FrameHead(
            frame=shown.number,
            lit_ns=lit_ns,
            width=levels.shape[1],
            height=levels.shape[0],
            bits=monitor.bits,
            q=self._attitude(shown),
            channels=1 if self._rgb is None and levels.ndim == 2 else 3,
            bench_sha256=self._bench.file.sha256,
            moment_ns=moment_ns,
            fades=shown.fades,
        )
        self._full.put(copied)

    def _moment_ns(self, shown: Shown) -> int | None:
        """The moment that a frame is a sample of: of one drawn in motion the middle of that. None
        with a screen.
        """
        if shown.predicted_swap_ns is not None:
            return None
        if shown.drawn.rate_cam_rad_s is None:
            return shown.moment_ns
        return shown.moment_ns + self._half_hold_ns

    def _attitude(self, shown: Shown) -> tuple[float, float, float, float] | None:
        if shown.attitude is None:
            return None
        q = shown.attitude.q_icrs_to_cam
        rate = shown.drawn.rate_cam_rad_s
        w, x, y, z = (
            q if rate is None else propagate(q, rate, self._bench.scan.hold_s / 2)
        ).tolist()
        return w, x, y, z

    def _send(self) -> None:
        while True:
            self.watched = self._sender.look()
            try:
                copied = self._full.get(timeout=LOOK_S)
            except queue.Empty:
                continue
            if copied is None:
                return
            if copied.head is not None:
                self._sender.put_frame(self._frame(copied.head, copied.levels))
                self.sent += 1
            self._free.put(copied)

    def _frame(self, head: FrameHead, levels: npt.NDArray[np.unsignedinteger[Any]]) -> ShownFrame:
        lit, codes = lit_codes(levels)
        if levels.ndim == 2 and self._rgb is not None:
            codes = self._rgb[codes].astype(code_dtype(head.bits))
        return ShownFrame(head, lit, codes)

    def close(self) -> None:
        """End the thread, then close the sender."""
        self._full.put(None)
        self._thread.join()
        self._sender.close()


def lit_codes(
    codes: npt.NDArray[np.unsignedinteger[Any]],
) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.unsignedinteger[Any]]]:
    """The flat indices (n,) of pixels over code 0, rising, and their codes, of an image (h, w) or
    (h, w, 3).
    """
    if codes.ndim == 3:
        lit = np.flatnonzero(codes.any(axis=2))
        return lit.astype(np.uint32), codes.reshape(-1, codes.shape[2])[lit]
    lit = lit_pixels(codes)
    return lit.astype(np.uint32), codes.ravel()[lit]


def lit_pixels(levels: npt.NDArray[np.unsignedinteger[Any]]) -> npt.NDArray[np.intp]:
    """The flat indices (n,) of levels over 0, rising: by words of eight bytes, in a sixth of the
    time where few are.
    """
    flat = levels.ravel()
    pixels_a_word = WORD_BYTES // flat.itemsize
    whole = len(flat) // pixels_a_word * pixels_a_word
    words = np.flatnonzero(flat[:whole].view(np.uint64))
    near = np.concatenate(
        [
            (words[:, None] * pixels_a_word + np.arange(pixels_a_word)).ravel(),
            np.arange(whole, len(flat)),
        ]
    )
    return np.asarray(near[flat[near] > 0])
