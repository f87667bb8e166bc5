"""Curves by wavelength, as users' files have them: channels of a detector, primaries of a panel."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

NM = np.arange(380.0, 781.0, 5.0)


def bump(middle_nm: float, width_nm: float, nm: NDArray = NM) -> NDArray:
    """A Gaussian with its 1/e half width."""
    return np.exp(-(((nm - middle_nm) / width_nm) ** 2))


# Three primaries each: as of a wide OLED, of an sRGB LCD whose red phosphor has two peaks, and of
# lasers.
PANELS = {
    "oled": [bump(625, 40), bump(530, 45), 0.8 * bump(460, 30)],
    "lcd": [bump(612, 12) + 0.6 * bump(645, 15), bump(540, 35), 1.2 * bump(450, 15)],
    "laser": [bump(638, 4), bump(520, 6), 1.5 * bump(445, 4)],
}


def write_curves(path: Path, nm: ArrayLike, curves: Mapping[str, ArrayLike]) -> Path:
    """A table of curves (n,) by wavelength, nm, each under its name, to 9 digits; its path."""
    lines = [",".join(["wavelength_nm", *curves])]
    for row in zip(nm, *curves.values(), strict=True):
        lines.append(",".join(f"{value:.9g}" for value in row))
    path.write_text("\n".join(lines) + "\n")
    return path


def write_curve(path: Path, nm: ArrayLike, values: ArrayLike) -> Path:
    """A table of one curve; its path."""
    return write_curves(path, nm, {"value": values})


def write_panel(path: Path, spectra: Iterable[ArrayLike], nm: ArrayLike = NM) -> Path:
    """A table of a panel's three primaries; its path."""
    return write_curves(path, nm, dict(zip("rgb", spectra, strict=True)))


def channel_keys(names: Iterable[str]) -> dict[str, object]:
    """The keys of [tracker] for channels whose curves are NAME.csv."""
    keys: dict[str, object] = {"quantum_efficiency": None}
    for name in names:
        keys[f"quantum_efficiency_{name}"] = f"{name}.csv"
    return keys


def write_channels(
    folder: Path, nm: ArrayLike, curves: Mapping[str, ArrayLike]
) -> dict[str, object]:
    """Each channel's curve as NAME.csv; the keys of [tracker] that name them."""
    for name, values in curves.items():
        write_curve(folder / f"{name}.csv", nm, values)
    return channel_keys(curves)
