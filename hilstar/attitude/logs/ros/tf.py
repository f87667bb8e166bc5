"""tf: a tree of frames. A chain of transforms, of which one moves, gives the attitude of one frame in another.

A transform that always has the same rotation is a part that does not move, whichever topic it comes on. Where several of a
chain move, their times differ, and the bag is refused: between two samples of one, the motion of another would be invented.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.logs.ros.turns import Turn
from hilstar.errors import InputError, shortened
from hilstar.rotation import multiply, normalise

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


class Chain(NamedTuple):
    """The transforms from a body up to the frame that its attitude refers to, and the one that moves."""

    body: str
    reference: str
    edges: tuple[Edge, ...]
    moving: Edge

    def turns(self) -> Iterator[tuple[int, Turn]]:
        """When each transform of the moving part was recorded, and the orientation of the whole chain then.

        Other parts are unit; the moving one keeps its norm, for its check.
        """
        below, above = (np.array([1.0, 0.0, 0.0, 0.0]) for _ in range(2))
        passed = False
        for edge in self.edges:
            if edge is self.moving:
                passed = True
            elif passed:
                above = multiply(normalise(edge.q[0]), above)
            else:
                below = multiply(normalise(edge.q[0]), below)
        whole = multiply(multiply(above, self.moving.q), below)
        times = zip(self.moving.received_ns, self.moving.stamps_ns, whole.tolist(), strict=True)
        for received_ns, stamp_ns, (w, x, y, z) in times:
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

        Raises InputError where the tree has no such chain, or more than one of its transforms moves.
        """
        body = self._only_body() if body is None else body
        edges = self._edges(body, reference)
        moving = [edge for edge in edges if edge.moves]
        if len(moving) > 1:
            names = _named(moving)
            between = "choose one with --reference FRAME=icrs and --body FRAME"
            raise InputError(f"{self._path}: of the transforms from {body!r} up, several move: {names}; {between}")
        longest = max(edges, key=lambda edge: len(edge.stamps_ns))
        for edge in edges:
            norm = np.linalg.norm(edge.q[0])
            if edge is not (moving or [longest])[0] and not 0.5 < norm < 2:
                raise InputError(
                    f"{self._path}: the transform {_named([edge])} has a quaternion of norm {norm:.3g}, no rotation"
                )
        return Chain(body, edges[-1].parent, edges, (moving or [longest])[0])

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
