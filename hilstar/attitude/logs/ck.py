"""SPICE C-kernels (CK Required Reading, types 1 to 6) as a log of one structure's attitude,
evaluated by SPICE itself.

Rules:
1. The C-matrix turns components of a segment's reference frame into the structure's. SPICE turns
   the reference frame into J2000, its name of the axes of the ICRF.
2. The angular velocity is the structure's with respect to J2000, rad/s, in the structure's
   components. A segment without one gives no rate (types 1 and 3), or a rate by differences of its
   attitudes (types 2, 4, 5 and 6, which are functions of time).
3. `t_ns` is TDB nanoseconds since 1970-01-01T00:00:00 TDB, which SPICE computes from clock ticks
   by the SCLK kernel.
4. Where nothing covers a time, or segments disagree, the previous attitude is held.

SPICE runs in a separate process (`ck_spice`): a damaged kernel may abort it, and the kernels of two
logs would mix in one process.
"""

import contextlib
import io
import json
import math
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.attitude.logs.entries import LogEntry, LogReading, Stated
from hilstar.attitude.logs.log_formats import LogFormat, require
from hilstar.attitude.wire.packet import checked_sample
from hilstar.attitude.wire.source import Conventions, components
from hilstar.basics.errors import InputError
from hilstar.basics.reading import by_number

BESIDE = (".tls", ".tsc", ".tf")  # NAIF's file endings of leap seconds, clocks and frames
MAX_BESIDE = 30
MAS_PER_RAD = math.degrees(1.0) * 3_600_000
LONGEST_S = 600.0  # the largest CK takes a few minutes
Arrays = Mapping[str, npt.NDArray[Any]]


def _kernels_beside(path: Path) -> list[Path]:
    """The leap second, clock and frame kernels in the CK's folder, in this order and within a kind
    by name. SPICE uses the last where several differ, so a later version counts.

    Numbers in names are compared as numbers: clock_10 comes after clock_9. Raises InputError where
    the folder cannot be searched, or has more than MAX_BESIDE kernels.
    """
    try:
        files = [
            file
            for file in path.resolve().parent.iterdir()
            if file.suffix.lower() in BESIDE and file.is_file()
        ]
    except OSError as error:
        raise InputError(
            f"{path}: its folder cannot be searched for kernels ({error.strerror}); give --kernel"
            " FILE"
        ) from error
    if len(files) > MAX_BESIDE:
        raise InputError(
            f"{path}: {len(files)} kernels lie beside it; name those that it needs: --kernel FILE"
        )
    return sorted(files, key=lambda file: (BESIDE.index(file.suffix.lower()), by_number(file)))


def _beside_line(kernels: list[Path]) -> str:
    """A notice's text: the kernels in the CK's folder in their order, and which one counts where
    there are several of a kind.
    """
    names = ", ".join(kernel.name for kernel in kernels) or "none"
    last_of_kind = {kernel.suffix.lower(): kernel.name for kernel in kernels}
    kinds = [kernel.suffix.lower() for kernel in kernels]
    counting = [last_of_kind[kind] for kind in BESIDE if kinds.count(kind) > 1]
    if counting:
        of_several = f"; where they differ, the last counts ({', '.join(counting)})"
    else:
        of_several = ""
    return f"kernels from beside the CK: {names}{of_several}; --kernel names others"


@contextlib.contextmanager
def _open(path: Path, stated: Stated) -> Iterator[LogReading]:
    require("spiceypy", "spice", f"{path}: a SPICE CK")
    yield read_ck(path, stated)


def read_ck(path: Path, stated: Stated) -> LogReading:
    """The attitudes of the CK's only structure, or of `stated.body` (an id or a name), by the
    kernels `stated.kernels` or, without these, by those in the CK's folder.

    Raises InputError for a damaged file, a missing kernel, and a CK with several structures where
    none is stated.
    """
    kernels = list(stated.kernels)
    notices = []
    if not kernels:
        kernels = _kernels_beside(path)
        notices.append(("kernels", _beside_line(kernels)))
    arrays, reply = _asked(path, kernels, stated.body)
    return reading_of(arrays, reply, notices)


def reading_of(
    arrays: Arrays, reply: dict[str, Any], notices: Iterable[tuple[str, str]] = ()
) -> LogReading:
    """The reading of what the process with SPICE answers: its arrays and the rest (see
    `ck_spice`), after the `notices` so far.
    """
    told = list(notices)
    if reply["step_s"] is not None:
        error = f"{reply['error_rad'] * MAS_PER_RAD:.2g} mas"
        told.append(
            (
                "ck-step",
                (
                    f"read every {reply['step_s']:.4g} s where the CK is a function of time; off by"
                    f" {error} between"
                ),
            )
        )
    gaps_s = reply["gaps_s"]
    if gaps_s:
        if len(gaps_s) == 1:
            count = "1 gap"
        else:
            count = f"{len(gaps_s)} gaps"
        told.append(
            (
                "log-gap",
                f"the CK has {count}, the longest {max(gaps_s):.6g} s; the attitude is held there",
            )
        )
    return LogReading(_entries(arrays), _conventions(reply), "give a CK whose times differ", told)


def _entries(arrays: Mapping[str, Any]) -> Iterator[LogEntry]:
    """The attitudes in the arrays of `ck_spice`, in their order; a rate of NaN means that there is
    none.
    """
    columns = [arrays[name].tolist() for name in ("t_ns", "q", "rate", "breaks", "tick")]
    for t_ns, q, rate, breaks, tick in zip(*columns, strict=True):
        known_rate = None if math.isnan(rate[0]) else rate
        sample = checked_sample(t_ns, q, known_rate, discontinuity=breaks)
        yield LogEntry(f", tick {tick:.17g}", sample)


def _asked(path: Path, kernels: list[Path], body: str | None) -> tuple[Arrays, dict[str, Any]]:
    """The arrays that the process with SPICE answers for a CK, and the rest of its answer. Raises
    InputError for what it refuses, where it breaks off, and after LONGEST_S.
    """
    request = json.dumps(
        {"path": str(path), "kernels": [str(kernel) for kernel in kernels], "body": body}
    )
    # The process imports hilstar from the same places as this one: -P keeps Python from adding the
    # working directory to them, and "" stands for that directory.
    places = os.pathsep.join(place or str(Path.cwd()) for place in sys.path)
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-m", "hilstar.attitude.logs.ck_spice"],
            input=request.encode(),
            capture_output=True,
            env=os.environ | {"PYTHONPATH": places},
            timeout=LONGEST_S,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise InputError(
            f"{path}: SPICE did not read it within {LONGEST_S:g} s; cut it into several (ckslicer)"
        ) from error
    if done.returncode:
        raise InputError(broken_off(path, done.stderr))
    with np.load(io.BytesIO(done.stdout)) as archive:
        arrays = dict(archive)
    answer = json.loads(str(arrays.pop("said")))
    if "error" in answer:
        raise InputError(answer["error"])
    return arrays, answer


def broken_off(path: Path, error_output: bytes) -> str:
    """The refusal of a CK with which the process broke off, by the last line that it wrote."""
    last = error_output.decode("utf-8", "replace").strip().splitlines()[-1:] or ["no word"]
    return f"{path}: SPICE broke off with it ({last[0]}); is it, or a kernel, damaged?"


def _conventions(said: dict[str, Any]) -> Conventions:
    return Conventions(
        f"SPICE CK, structure {said['structure']}",
        f"the C-matrix turns components of {', '.join(said['references'])} (by SPICE: J2000, the"
        " ICRF) into the structure's",
        "scalar first, as m2q gives it for the C-matrix",
        "TDB from 1970-01-01T00:00:00 TDB (ephemeris time + 946728000 s), from clock ticks by the"
        " SCLK kernel",
        of_body=True,
        written=lambda q: f"m2q(C), C from J2000 = {components(q)}",
        scale="TDB",
    )


log_format = LogFormat(
    "a SPICE CK",
    _open,
    listed="SPICE CKs",
    uses=frozenset({"mounting", "kernels", "body"}),
    magic=(b"DAF/CK",),
)
