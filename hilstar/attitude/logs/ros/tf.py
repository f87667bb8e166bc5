"""tf: a tree of frames. A chain of transforms gives the attitude of one frame in another.

A transform that always has the same rotation is a part that does not move, whichever topic it comes on. Where several of a
chain move, the attitudes have the times of the one with the most samples, and the others are interpolated to those (SLERP, as
tf2 does), never beyond their own.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.attitude.logs.ros.turns import Turn
from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.errors import InputError, shortened
from hilstar.rotation import conjugate, from_rotation_vectors, multiply, normalise, to_rotation_vector

IntArray = npt.NDArray[np.int64]
MAX_EDGES = 10_000
MAX_NAMED = 8


@dataclass(slots=True)
class Edge:
    """Every transform from one child to one parent: times (header's and recorder's), and (w, x, y, z) from child to parent."""

    parent: str
    child: str
    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    received_ns: array[int] = field(default_factory=lambda: array("q"))
    numbers: array[float] = field(default_factory=lambda: array("d"))
    moves: bool = False

    def add(self, turn: Turn, received_ns: int) -> None:
        """One more transform."""
        self.moves |= bool(self.numbers) and tuple(self.numbers[:4]) != turn.q
        self.stamps_ns.append(turn.stamp_ns or 0)
        self.received_ns.append(received_ns)
        self.numbers.extend(turn.q)

    @property
    def q(self) -> FloatArray:
        """(n, 4), as recorded."""
        return np.array(self.numbers, dtype=np.float64).reshape(-1, 4)

    @property
    def times_ns(self) -> IntArray:
        """(n,): the stamps, or where they are not set when the transforms were recorded."""
        stamps = np.array(self.stamps_ns, dtype=np.int64)
        return stamps if stamps.any() else np.array(self.received_ns, dtype=np.int64)

    def at(self, t_ns: IntArray) -> FloatArray:
        """The rotations (m, 4) at other times (m,); NaN before its first and after its last."""
        q = normalise(self.q)
        if not self.moves:
            return np.tile(q[0], (len(t_ns), 1))
        times, first = np.unique(self.times_ns, return_index=True)
        q = q[first]
        if len(times) < 2:
            return np.where((t_ns == times[0])[:, None], q[0], np.nan)
        after = np.clip(np.searchsorted(times, t_ns), 1, len(times) - 1)
        share = (t_ns - times[after - 1]) / (times[after] - times[after - 1])
        turn = to_rotation_vector(multiply(q[after], conjugate(q[after - 1])))
        found = multiply(from_rotation_vectors(share[:, None] * turn), q[after - 1])
        found[(t_ns < times[0]) | (t_ns > times[-1])] = np.nan
        return found


class Chain(NamedTuple):
    """The transforms from a body up to the frame that its attitude refers to, and the one whose times the attitudes have."""

    body: str
    reference: str
    edges: tuple[Edge, ...]
    timed: Edge

    def turns(self, told: list[tuple[str, str]]) -> Iterator[tuple[int, Turn]]:
        """When each transform of the timed part was recorded, and the orientation of the whole chain then.

        Other parts are unit; the timed one keeps its norm, for its check.
        """
        t_ns = self.timed.times_ns
        whole = np.tile([1.0, 0.0, 0.0, 0.0], (len(t_ns), 1))
        known = np.ones(len(t_ns), dtype=bool)
        for edge in self.edges:
            part = self.timed.q if edge is self.timed else edge.at(t_ns)
            known &= np.isfinite(part).all(axis=1) | (edge is self.timed)
            with np.errstate(all="ignore"):  # of the timed part, what is not finite is refused where it is checked
                whole = multiply(part, whole)
        others = [edge for edge in self.edges if edge.moves and edge is not self.timed]
        if others:
            told.append(("log-tf", f"{_named(others)} interpolated (SLERP) to the times of {_named([self.timed])}"))
        if not known.all():
            told.append(
                ("log-tf", f"{int((~known).sum())} attitudes at times that not all of these transforms have are left out")
            )
        rows = zip(known.tolist(), self.timed.received_ns, self.timed.stamps_ns, whole.tolist(), strict=True)
        for is_known, received_ns, stamp_ns, (w, x, y, z) in rows:
            if is_known:
                yield received_ns, Turn(stamp_ns, self.reference, self.body, (w, x, y, z))


class Tree:
    """The transforms of a bag."""

    def __init__(self, path: Path, transforms: Iterable[tuple[int, Turn]]) -> None:
        self._path = path
        self._up: dict[str, dict[str, Edge]] = {}
        count = 0
        for received_ns, turn in transforms:
            parents = self._up.setdefault(turn.body or "", {})
            edge = parents.get(turn.reference or "")
            if edge is None:
                count += 1
                if count > MAX_EDGES:
                    raise InputError(f"{path}: tf has more than {MAX_EDGES} transforms; record those that are wanted")
                edge = parents[turn.reference or ""] = Edge(turn.reference or "", turn.body or "")
            edge.add(turn, received_ns)

    def chain(self, body: str | None, reference: str | None) -> Chain:
        """From `body` up to `reference`, or as far as the tree goes; the body may be left out where one frame moves.

        Raises InputError where the tree has no such chain, or one of its transforms is no rotation.
        """
        body = self._only_body() if body is None else body
        edges = self._edges(body, reference)
        timed = max(edges, key=lambda edge: (edge.moves, len(edge.stamps_ns)))
        for edge in edges:
            with np.errstate(over="ignore"):
                worst = float(np.abs(np.linalg.norm(edge.q, axis=1) - 1).max())
            if edge is not timed and not worst <= NORM_TOLERANCE:
                raise InputError(
                    f"{self._path}: the transform {_named([edge])} has a quaternion whose norm is off by {worst:.3g}"
                )
        return Chain(body, edges[-1].parent, edges, timed)

    def _only_body(self) -> str:
        edges = [edge for parents in self._up.values() for edge in parents.values()]
        moving = [edge for edge in edges if edge.moves] or edges
        if len(moving) != 1:
            raise InputError(
                f"{self._path}: several transforms of tf could be meant: {_named(moving)}; choose with --body FRAME"
            )
        return moving[0].child

    def _edges(self, body: str, reference: str | None) -> tuple[Edge, ...]:
        found: list[Edge] = []
        frame, seen = body, {body}
        while frame in self._up and frame != reference:
            parents = list(self._up[frame].values())
            if len(parents) > 1:
                raise InputError(f"{self._path}: in tf, {frame!r} has several parents: {_named(parents)}; record one of them")
            found.append(parents[0])
            frame = parents[0].parent
            if frame in seen:
                raise InputError(f"{self._path}: tf goes in a circle at {frame!r}: {_named(found)}")
            seen.add(frame)
        if not found or (reference is not None and frame != reference):
            wanted = f"from {body!r} up to {reference!r}" if reference is not None and found else f"of {body!r}"
            edges = _named([edge for parents in self._up.values() for edge in parents.values()])
            raise InputError(f"{self._path}: tf has no transform {wanted}; it has {edges}")
        return tuple(found)


def _named(edges: list[Edge]) -> str:
    names = [f"{edge.parent} -> {edge.child}" for edge in edges[:MAX_NAMED]]
    return shortened(", ".join([*names, *(["..."] if len(edges) > MAX_NAMED else [])]), 400)
