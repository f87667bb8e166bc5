"""What the frame loop leaves for the page after each frame: a few numbers, and now and then a picture.

The loop's own thread writes them, in microseconds: it takes no lock, makes no call that waits, and copies a picture at most
ten times a second, and only while somebody looks at one.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import numpy as np

from hilstar.console.feed.board import MAX_SPRITES, PICTURE_HEAD_BYTES, SPRITE, Board
from hilstar.console.feed.messages import BLANK, FRAME, HAS_AGE, MISSING, STALE, PictureHead
from hilstar.scene.sprites import brightest
from hilstar.units import NS_PER_S

if TYPE_CHECKING:
    from hilstar.run.serve import Running
    from hilstar.run.shown import Shown
    from hilstar.scene.sprites import Sprites

MIN_PICTURE_NS = NS_PER_S // 10


class Feed:
    """Writes a run onto its board."""

    def __init__(self, board: Board) -> None:
        self.shown: Shown | None = None
        self.count = 0  # of frames
        self.running: Running | None = None
        self._board = board
        self._picture_due_ns = 0

    def follow(self, running: Running) -> None:
        """Take the run, which goes on counting."""
        self.running = running

    def see(self, shown: Shown) -> None:
        """Take a frame; for the frame loop."""
        self.shown = shown
        self.count += 1
        running, attitude = self.running, shown.attitude
        if running is None:
            return
        tally, packets = running.loop.tally, running.packets
        flags = STALE * shown.stale | MISSING * shown.missing | BLANK * (attitude is None) | HAS_AGE * (attitude is not None)
        self._board.frames.put(
            FRAME.pack(
                shown.number,
                shown.draw_ns,
                shown.swap_ns,
                shown.predicted_swap_ns or shown.swap_ns,
                0 if attitude is None else max(min(attitude.age_ns, 2**62), -(2**62)),
                shown.missed_before,
                tally.frames,
                tally.missed_frames,
                tally.stale_frames,
                tally.given_up_frames,
                packets.received,
                packets.refused,
                flags,
            )
        )
        want = self._board.want
        if want.each_ns and self._picture_due_ns <= shown.swap_ns < want.until_ns:
            self._picture_due_ns = shown.swap_ns + max(want.each_ns, MIN_PICTURE_NS)
            with contextlib.suppress(ValueError):  # levels of another size than the bench's: no picture, and the run goes on
                self._copy(shown)

    def _copy(self, shown: Shown) -> None:
        """Copy the picture: its levels, its attitude, and where the stars in it are."""
        ring, levels, sprites = self._board.pictures, shown.drawn.levels, shown.drawn.sprites
        height, width = levels.shape
        count = 0 if sprites is None else min(len(sprites), MAX_SPRITES)
        start = PICTURE_HEAD_BYTES
        end = start + levels.nbytes
        whole = end + count * SPRITE.itemsize
        ring.begin()
        room = ring.room(whole)
        q = () if shown.attitude is None else shown.attitude.q_icrs_to_cam.tolist()
        head = PictureHead(shown.number, shown.swap_ns, shown.t_ns, width, height, levels.itemsize, count, *q).pack()
        room[: len(head)] = head
        np.copyto(np.frombuffer(room[start:end], dtype=levels.dtype).reshape(height, width), levels)
        if sprites is not None and count:
            _copy_sprites(np.frombuffer(room[end:], dtype=SPRITE), sprites)
        ring.end(whole, 0)


def _copy_sprites(target: np.ndarray, sprites: Sprites) -> None:
    kept = brightest(sprites.data["electrons_per_s"], MAX_SPRITES)
    which = slice(None) if kept is None else kept
    target["star"], target["x_px"], target["y_px"] = sprites.star[which], sprites.x_px[which], sprites.y_px[which]
