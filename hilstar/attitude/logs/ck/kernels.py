"""The kernels that a CK needs: found beside it, checked, loaded."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hilstar.attitude.logs.ck.daf import read_daf
from hilstar.errors import InputError, shortened
from hilstar.reading import HEAD_BYTES, open_regular

BESIDE = (".tls", ".tsc", ".tf")  # leap seconds, clocks and frames, as NAIF ends their names
MAX_BESIDE = 30
MAX_TEXT_BYTES = 50_000_000
MAX_BINARY_BYTES = 4_000_000_000
MAX_NAMED = 1000  # kernels of one meta-kernel
ADVICE = "give a SPICE kernel (.tls, .tsc, .tf, .tm, ...)"


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
