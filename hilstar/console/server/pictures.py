"""The newest picture, packed for the page: levels, and the truth of the same frame to be drawn over them."""

from __future__ import annotations

import json
import struct
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.console.feed.board import PICTURE_HEAD_BYTES, SPRITE, Board
from hilstar.console.feed.messages import PictureHead, RunSeen
from hilstar.console.feed.scene import Scene
from hilstar.console.overlay import MAX_STARS
from hilstar.monitor.response import Codes

LEVEL = 1  # of zlib: a night sky is nearly all zeros


@dataclass(frozen=True, eq=False)
class Packed:
    """A picture's message, and the truth of its frame without and with the grid of RA and Dec."""

    number: int
    picture: bytes
    truth: bytes
    truth_with_grid: bytes


class PictureRoom:
    """Packs what the board has; it takes ten to thirty milliseconds, on a thread of its own."""

    def __init__(self, board: Board, scene: Scene | None) -> None:
        self._board, self._scene = board, scene

    def newest(self, after: int, seen: RunSeen | None) -> Packed | None:
        """The newest picture, None where there is none after that number."""
        found = self._board.pictures.last() if self._board.pictures.newest > after else None
        if found is None or found[0] <= after:
            return None
        number, data = found
        head = PictureHead.unpack(data)
        levels, sprites = _parts(head, data)
        if self._scene is not None and seen is not None and seen.overlay and not self._scene.aids_in_levels:
            levels = self._scene.aids.laid_over(levels, seen.overlay, seen.patch_share)
        truth, with_grid = self._truths(head, sprites, seen)
        return Packed(number, _message(head, levels), _told(truth), _told(with_grid))

    def _truths(self, head: PictureHead, sprites: np.ndarray, seen: RunSeen | None) -> tuple[dict[str, Any], dict[str, Any]]:
        """The truth of a picture, without and with the grid."""
        if self._scene is None:
            nothing = {"frame": head.frame, "stars": []}
            return nothing, nothing
        marks = self._scene.marks.told(_attitude(head), grid=True)
        grid = marks.pop("grid", [])
        truth = {"frame": head.frame, "stars": stars_of(self._scene, sprites, seen)} | marks
        return truth, truth | {"grid": grid}


def _parts(head: PictureHead, data: bytes) -> tuple[Codes, np.ndarray]:
    count = head.width * head.height
    dtype = np.dtype(f"<u{head.item_bytes}")
    levels = np.frombuffer(data, dtype=dtype, count=count, offset=PICTURE_HEAD_BYTES).reshape(head.height, head.width)
    sprites = np.frombuffer(data, dtype=SPRITE, count=head.sprites, offset=PICTURE_HEAD_BYTES + count * head.item_bytes)
    return levels, sprites


def _message(head: PictureHead, levels: Codes) -> bytes:
    """A length, a head in JSON of that many bytes, and the levels."""
    told = {"w": head.width, "h": head.height, "frame": head.frame, "dtype": f"u{head.item_bytes}", "deflate": True}
    text = json.dumps(told).encode()
    return struct.pack("<I", len(text)) + text + zlib.compress(np.ascontiguousarray(levels).tobytes(), LEVEL)


def _told(truth: dict[str, Any]) -> bytes:
    return json.dumps({"truth": truth}, ensure_ascii=False, separators=(",", ":"), allow_nan=False).encode()


def stars_of(scene: Scene, sprites: np.ndarray, seen: RunSeen | None) -> list[list[Any]]:
    """Where the stars of a picture were drawn, as `[x_px, y_px, v_mag, hip, label, clipped]`, the brightest first."""
    stars, x_px, y_px = _one_each(sprites)
    clipped = set() if seen is None else set(seen.clipped)
    rows: list[list[Any]] = []
    for k in np.argsort(scene.v_mag[stars], kind="stable")[:MAX_STARS].tolist():
        star = int(stars[k])
        hip, label = int(scene.hip[star]), scene.label(star)
        rows.append(
            [
                round(x_px[k], 2),
                round(y_px[k], 2),
                _number(float(scene.v_mag[star])),
                hip,
                label,
                int((hip or label) in clipped),
            ]
        )
    return rows


def _number(magnitude: float) -> float | None:
    return round(magnitude, 2) if np.isfinite(magnitude) else None


def _one_each(sprites: np.ndarray) -> tuple[np.ndarray, list[float], list[float]]:
    """The stars of sprites and the middle of each star's: one that moves has several along its path."""
    stars, which = np.unique(sprites["star"], return_inverse=True)
    count = np.bincount(which, minlength=len(stars))
    x_px, y_px = (np.bincount(which, sprites[axis], len(stars)) / np.maximum(count, 1) for axis in ("x_px", "y_px"))
    return stars, x_px.tolist(), y_px.tolist()


def _attitude(head: PictureHead) -> FloatArray | None:
    q = np.array([head.q_w, head.q_x, head.q_y, head.q_z])
    return q if np.isfinite(q).all() else None
