"""SPICE C-kernels (CK Required Reading, types 1 to 6) as a log of one structure's attitude, evaluated by SPICE itself.

Rules:
1. The C-matrix turns components of a segment's reference frame into the structure's; SPICE turns the reference into J2000,
   its name of the axes of the ICRF.
2. The angular velocity is the structure's with respect to J2000, in the structure's components. A segment without one gives no
   rate (types 1 and 3), or the rate of its own function by difference (types 2, 4, 5 and 6).
3. `t_ns` is TDB nanoseconds since 1970-01-01T00:00:00 TDB, which the SCLK kernel computes from ticks.
4. Where nothing covers a time, or segments disagree, the previous attitude is held.

SPICE runs in a process of its own (`ck_spice`). DAF summaries are read here without SPICE, which would follow a damaged list
of records forever.
"""

from __future__ import annotations

import importlib.util
import io
import json
import math
import os
import struct
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.attitude.logs.entries import LogEntry, LogReading, Stated
from hilstar.attitude.wire.packet import checked_sample
from hilstar.attitude.wire.source import Conventions, components
from hilstar.errors import InputError, MachineError, shortened
from hilstar.reading import HEAD_BYTES, open_regular

RECORD_BYTES, WORD_BYTES = 1024, 8
ORDERS = {b"LTL-IEEE": "<", b"BIG-IEEE": ">"}
MAX_SUMMARIES = 100_000
BESIDE = (".tls", ".tsc", ".tf")  # leap seconds, clocks and frames, as NAIF ends their names
MAX_BESIDE = 30
MAX_TEXT_BYTES = 50_000_000
MAX_BINARY_BYTES = 4_000_000_000
MAX_NAMED = 1000  # kernels of one meta-kernel
ADVICE = "give a SPICE kernel (.tls, .tsc, .tf, .tm, ...)"
MAS_PER_RAD = math.degrees(1.0) * 3_600_000
LONGEST_S = 600.0  # the largest CK takes a few minutes
Arrays = Mapping[str, npt.NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Summary:
    """One array of a DAF: the summary's doubles and integers, of which the last two are the first and last word (from 1)."""

    doubles: tuple[float, ...]
    integers: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Daf:
    """A DAF whose list of summaries is whole, and whose arrays lie within the file."""

    path: Path
    order: str
    summaries: list[Summary]

    def words(self, summary: Summary) -> FloatArray:
        """The doubles (n,) of an array. Raises InputError where the file cannot be read."""
        first, last = summary.integers[-2:]
        with open_regular(self.path, "give a SPICE kernel") as file:
            file.seek((first - 1) * WORD_BYTES)
            raw = file.read((last - first + 1) * WORD_BYTES)
        if len(raw) != (last - first + 1) * WORD_BYTES:
            raise InputError(f"{self.path}: was cut while it was read; copy it whole")
        return np.frombuffer(raw, self.order + "f8").astype(np.float64)


def read_daf(path: Path, limit_bytes: int) -> Daf:
    """The summaries of a DAF, in the file's order. Raises InputError for a file that is not one, or is damaged."""
    with open_regular(path, "give a SPICE kernel", limit_bytes) as file:
        size = os.fstat(file.fileno()).st_size
        head = file.read(RECORD_BYTES)
        order = ORDERS.get(head[88:96])
        if len(head) < RECORD_BYTES:
            raise InputError(f"{path}: has {len(head)} bytes, less than a DAF's first record; is it cut off?")
        if not head.startswith(b"DAF/") or order is None:
            format_text = head[88:96].decode("ascii", "replace").strip() or "missing"
            raise InputError(f"{path}: is no DAF in IEEE form (its form is {shortened(format_text)}); convert it by tobin")
        doubles, integers = struct.unpack(order + "2i", head[8:16])
        first, last = struct.unpack(order + "2i", head[76:84])
        words = doubles + (integers + 1) // 2
        if not (0 <= doubles <= 124 and 2 <= integers <= 250 and words <= 125):
            raise InputError(f"{path}: is a damaged DAF: its summaries have {doubles} doubles and {integers} integers")
        return Daf(path, order, _summaries(file, _DafLayout(path, order, doubles, integers, size), first, last))


@dataclass(frozen=True, slots=True)
class _DafLayout:
    path: Path
    order: str
    doubles: int
    integers: int
    size_bytes: int

    def fault(self, what: str) -> InputError:
        return InputError(f"{self.path}: is a damaged DAF: {what}; is it cut off?")


def _summaries(file: IO[bytes], layout: _DafLayout, first: int, last: int) -> list[Summary]:
    """The summaries of the list of records from `first` to `last`; each record names the next and the previous one."""
    found: list[Summary] = []
    seen: set[int] = set()
    record, previous = first, 0
    while record:
        if record in seen or not 1 < record <= layout.size_bytes // RECORD_BYTES:
            raise layout.fault(f"its list of summaries leads to record {record}")
        seen.add(record)
        file.seek((record - 1) * RECORD_BYTES)
        raw = file.read(RECORD_BYTES)
        following, before, count = struct.unpack(layout.order + "3d", raw[:24])
        words = layout.doubles + (layout.integers + 1) // 2
        if before != previous or not 0 <= count <= 125 // words or not (0 <= following < 2**31 and following.is_integer()):
            raise layout.fault(f"summary record {record} is not one of its list")
        found += [_summary(raw[(3 + k * words) * WORD_BYTES :], layout) for k in range(int(count))]
        if len(found) > MAX_SUMMARIES:
            raise InputError(f"{layout.path}: has more than {MAX_SUMMARIES} segments; split it into several")
        record, previous = int(following), record
    if previous != last:
        raise layout.fault(f"its list of summaries ends at record {previous}, not {last}")
    return found


def _summary(raw: bytes, layout: _DafLayout) -> Summary:
    doubles = struct.unpack_from(f"{layout.order}{layout.doubles}d", raw)
    integers = struct.unpack_from(f"{layout.order}{layout.integers}i", raw, layout.doubles * WORD_BYTES)
    begin, end = integers[-2:]
    if not RECORD_BYTES // WORD_BYTES < begin <= end <= layout.size_bytes // WORD_BYTES:
        raise layout.fault(f"an array has the words {begin} to {end} of {layout.size_bytes // WORD_BYTES}")
    return Summary(doubles, integers)


def kernels_beside(path: Path) -> list[Path]:
    """The leap second, clock and frame kernels in the CK's folder, in that order and by name: a later version counts."""
    try:
        files = sorted(file for file in path.resolve().parent.iterdir() if file.suffix.lower() in BESIDE and file.is_file())
    except OSError as error:
        raise InputError(f"{path}: its folder cannot be searched for kernels ({error.strerror}); give --kernel FILE") from error
    if len(files) > MAX_BESIDE:
        raise InputError(f"{path}: {len(files)} kernels lie beside it; name those that it needs: --kernel FILE")
    return sorted(files, key=lambda file: BESIDE.index(file.suffix.lower()))


def load(spice: Any, path: Path, kernels: Sequence[Path]) -> None:
    """Load the kernels and then the CK, which so comes before any other; files are checked first (InputError)."""
    for kernel in kernels:
        for file in _checked(spice, kernel):
            spice.furnsh(str(file))
    spice.furnsh(str(path))


def in_words(error: Any) -> str:
    """What SPICE says, and what to give where a kernel is missing."""
    said = shortened(" ".join(str(error.long or error.explain or error.short).split()), 300)
    if "SCLK" in said and ("not found" in said or "kernel" in said.lower()):
        return f"its clock is unknown; give its SCLK kernel, and leap seconds: --kernel FILE.tsc ({said})"
    if "frame" in said.lower():
        return f"a frame has no place among the stars; give what orients it: --kernel FILE.tf, or its own .bc, or .tpc ({said})"
    return f"SPICE refuses it ({said})"


def _checked(spice: Any, kernel: Path) -> list[Path]:
    """The files of a kernel, checked before SPICE opens them: itself, or those that a meta-kernel names."""
    with open_regular(kernel, ADVICE) as file:
        head = file.read(HEAD_BYTES)
    if head.startswith(b"DAF/"):
        read_daf(kernel, MAX_BINARY_BYTES)
        return [kernel]
    if head.startswith((b"DAFETF", b"DASETF")):
        raise InputError(f"{kernel}: is a transfer file; convert it by tobin")
    open_regular(kernel, ADVICE, MAX_TEXT_BYTES).close()
    if not head.startswith(b"KPL/MK") and kernel.suffix.lower() != ".tm":
        return [kernel]
    return [file for named in _named(spice, kernel) for file in _checked_leaf(spice, kernel, named)]


def _checked_leaf(spice: Any, meta: Path, named: Path) -> list[Path]:
    with open_regular(named, f"{meta} names it") as file:
        if file.read(HEAD_BYTES).startswith(b"KPL/MK"):
            raise InputError(f"{meta}: names another meta-kernel, {named}; name its kernels instead")
    return _checked(spice, named)


def _named(spice: Any, meta: Path) -> list[Path]:
    """The kernels that a meta-kernel names, its path symbols replaced; from the working directory, as SPICE has it."""
    spice.ldpool(str(meta))
    files = _strings(spice, "KERNELS_TO_LOAD")
    symbols, values = _strings(spice, "PATH_SYMBOLS"), _strings(spice, "PATH_VALUES")
    for name in ("KERNELS_TO_LOAD", "PATH_SYMBOLS", "PATH_VALUES"):
        spice.dvpool(name)
    if not files or len(symbols) != len(values):
        raise InputError(f"{meta}: names no kernels; write KERNELS_TO_LOAD, and as many PATH_VALUES as PATH_SYMBOLS")
    for symbol, value in sorted(zip(symbols, values, strict=True), key=lambda pair: -len(pair[0])):
        files = [file.replace(f"${symbol}", value) for file in files]
    return [Path(file) for file in files]


def _strings(spice: Any, name: str) -> list[str]:
    """The strings of a variable of the pool; one that ends in + goes on in the next."""
    found: list[str] = []
    for k in range(MAX_NAMED + 1):
        text, _, there = spice.stpool(name, k, "+")
        if not there:
            return found
        found.append(text)
    raise InputError(f"a meta-kernel has more than {MAX_NAMED} {name}; split it into several")


def read_ck(path: Path, stated: Stated) -> LogReading:
    """The attitudes of the CK's only structure, or of `stated.body` (an id or a name), with the kernels stated or beside it.

    Raises InputError for a file that is damaged, a kernel that is missing and a choice that is open; MachineError without
    spiceypy.
    """
    if importlib.util.find_spec("spiceypy") is None:
        raise MachineError(f"{path}: a SPICE CK; reading it needs spiceypy: pip install 'hilstar[spice]'")
    kernels, told = list(stated.kernels), []
    if not kernels:
        kernels = kernels_beside(path)
        names = ", ".join(kernel.name for kernel in kernels) or "none"
        told.append(("kernels", f"kernels from beside the CK: {names}; --kernel names others"))
    arrays, said = _asked(path, kernels, stated.body)
    return LogReading(_entries(arrays), _conventions(said), "give a CK whose times differ", told + _told(said))


def _asked(path: Path, kernels: list[Path], body: str | None) -> tuple[Arrays, dict[str, Any]]:
    """Ask the process that runs SPICE: its arrays, and the rest of its answer."""
    request = json.dumps({"path": str(path), "kernels": [str(kernel) for kernel in kernels], "body": body})
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
        raise InputError(f"{path}: SPICE did not read it within {LONGEST_S:g} s; cut it into several (ckslicer)") from error
    if done.returncode:
        last = done.stderr.decode("utf-8", "replace").strip().splitlines()[-1:] or ["no word"]
        raise InputError(f"{path}: SPICE broke off with it ({last[0]}); is it, or a kernel, damaged?")
    with np.load(io.BytesIO(done.stdout)) as archive:
        arrays = dict(archive)
    said = json.loads(str(arrays.pop("said")))
    if "error" in said:
        raise InputError(said["error"])
    return arrays, said


def _entries(arrays: Arrays) -> Iterator[LogEntry]:
    known: list[bool] = (~np.isnan(arrays["rate"][:, 0])).tolist()
    rows = zip(*(arrays[name].tolist() for name in ("t_ns", "q", "rate", "breaks", "tick")), strict=True)
    for has_rate, (t_ns, q, rate, breaks, tick) in zip(known, rows, strict=True):
        yield LogEntry(f", tick {tick:.17g}", checked_sample(t_ns, q, rate if has_rate else None, discontinuity=breaks))


def _conventions(said: dict[str, Any]) -> Conventions:
    """What the numbers of one structure mean."""
    return Conventions(
        f"SPICE CK, structure {said['structure']}",
        f"the C-matrix turns components of {', '.join(said['references'])} (by SPICE: J2000, the ICRF) into the structure's",
        "scalar first, as m2q gives it for the C-matrix",
        "TDB from 1970-01-01T00:00:00 TDB (ephemeris time + 946728000 s), from clock ticks by the SCLK kernel",
        of_body=True,
        written=lambda q: f"m2q(C), C from J2000 = {components(q)}",
        scale="TDB",
    )


def _told(said: dict[str, Any]) -> list[tuple[str, str]]:
    told = []
    if said["step_s"] is not None:
        error = f"{said['error_rad'] * MAS_PER_RAD:.2g} mas"
        told.append(
            ("ck-step", f"read every {said['step_s']:.4g} s where the CK is a function of time; off by {error} between")
        )
    gaps_s = said["gaps_s"]
    if gaps_s:
        count = "1 gap" if len(gaps_s) == 1 else f"{len(gaps_s)} gaps"
        told.append(("log-gap", f"the CK has {count}, the longest {max(gaps_s):.6g} s; the attitude is held there"))
    return told
