"""SPICE in a process of its own: a damaged kernel may abort it, and its pool of kernels is one for the whole process.

A request is one JSON object on stdin, `path`, `kernels` and `body`; the answer is an NPZ file on stdout: what `Sampled` has,
and `said`, JSON text with the rest, or with `error` alone.
"""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.attitude.logs.ck.daf import Daf
from hilstar.attitude.logs.ck.kernels import in_words, load
from hilstar.attitude.logs.ck.pieces import pieces_of
from hilstar.attitude.logs.ck.pointing import Structure
from hilstar.attitude.logs.ck.sampling import Sampled, sample
from hilstar.attitude.logs.ck.segments import Coverage, Segment, coverage, read_segments
from hilstar.errors import InputError

MAX_CK_BYTES = 500_000_000
MAX_NAMED_BODIES = 12
CK_CLASS = 3  # of a frame whose attitude is in CKs


def answer(path: Path, kernels: list[Path], stated: str | None) -> tuple[Sampled, dict[str, Any]]:
    """The attitudes of the CK's structure, with its name and the frames that its segments refer to. Raises InputError."""
    import spiceypy

    daf, segments = read_segments(path, MAX_CK_BYTES)
    try:
        with spiceypy.no_found_check():
            load(spiceypy, path, kernels)
            body = _body(spiceypy, path, segments, stated)
            own = [segment for segment in segments if segment.body == body]
            pieces = pieces_of(list(zip(own, _coverages(spiceypy, daf, own), strict=True)))
            if not pieces:
                raise InputError(f"{path}: its segments of {body} cover no time")
            structure = Structure(path, spiceypy, body, all(segment.has_rate for segment in own))
            references = sorted({spiceypy.frmnam(segment.reference) or str(segment.reference) for segment in own})
            return sample(structure, pieces), {"structure": _name(spiceypy, body), "references": references}
    except spiceypy.utils.exceptions.SpiceyError as error:
        raise InputError(f"{path}: {in_words(error)}") from error


def _coverages(spice: Any, daf: Daf, segments: list[Segment]) -> list[Coverage]:
    """What each segment covers; SPICE tells the intervals of types 4 and 6."""
    found = [coverage(daf, segment) for segment in segments]
    if None not in found:
        return [each for each in found if each is not None]
    words = sum(segment.summary.integers[-1] - segment.summary.integers[-2] for segment in segments)
    window = spice.ckcov(str(daf.path), segments[0].body, False, "INTERVAL", 0.0, "SCLK", spice.cell_double(words + 2))
    intervals = np.array(list(window), dtype=np.float64).reshape(-1, 2)
    result = []
    for segment, each in zip(segments, found, strict=True):
        within = np.clip(intervals, segment.start, segment.stop)
        touched = (intervals[:, 0] <= segment.stop) & (intervals[:, 1] >= segment.start)
        result.append(Coverage(within[touched], np.empty(0)) if each is None else each)
    return result


def _body(spice: Any, path: Path, segments: list[Segment], stated: str | None) -> int:
    """The id of the structure: the only one, or what the user states."""
    bodies = sorted({segment.body for segment in segments})
    named = ", ".join(_name(spice, body) for body in bodies[:MAX_NAMED_BODIES]) + (", ..." * (len(bodies) > MAX_NAMED_BODIES))
    if stated is None:
        if len(bodies) > 1:
            raise InputError(f"{path}: contains several structures, {named}; choose one: --body ID")
        return bodies[0]
    body = _id_of(spice, stated)
    if body not in bodies:
        raise InputError(f"{path}: contains no structure {stated!r}; it has {named}: --body ID, or a name of its frame kernel")
    return body


def _id_of(spice: Any, stated: str) -> int | None:
    """The id that a user means: a number, a frame's name or a body's."""
    try:
        return int(stated)
    except ValueError:
        frame = spice.namfrm(stated)
        _, kind, identity, found = spice.frinfo(frame) if frame else (0, 0, 0, False)
        if found and kind == CK_CLASS:
            return int(identity)
        body, found = spice.bods2c(stated)
        return int(body) if found else None


def _name(spice: Any, body: int) -> str:
    _, name, _, found = spice.ccifrm(CK_CLASS, body)
    return f"{body} ({name})" if found and name else str(body)


def main() -> None:
    """Answer the request on stdin."""
    request = json.loads(sys.stdin.read())
    arrays: dict[str, Any] = {}
    try:
        found, said = answer(Path(request["path"]), [Path(name) for name in request["kernels"]], request["body"])
        arrays = {"t_ns": found.t_ns, "q": found.q, "rate": found.rate, "breaks": found.breaks, "tick": found.tick}
        said |= {"step_s": found.step_s, "error_rad": found.error_rad, "gaps_s": found.gaps_s}
    except InputError as error:
        said = {"error": str(error)}
    packed = io.BytesIO()
    np.savez(packed, said=np.array(json.dumps(said)), **arrays)
    sys.stdout.buffer.write(packed.getvalue())


if __name__ == "__main__":
    main()
