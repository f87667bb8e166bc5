"""Make the spectra of primaries in configs: an LCD's and a CRT's as measured, shapes of an OLED's
and of a projector's lasers.

    pip install colour-science==0.4.7      (an environment of its own will do)
    python tools/make_primaries.py

No measured spectra of an OLED or of lasers were found under a free licence, so those two are the
study's Gaussians, and say so.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from hilstar.instruments.study.colour import NM, PANELS, curve_of

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
MEASURED = {
    "lcd": (
        "Apple Studio Display",
        "Fairchild and Wyble 1998, Colorimetric characterization of the Apple Studio Display, RIT",
    ),
    "crt": ("Typical CRT Brainard 1997", "Brainard 1997, in Machado 2010"),
}
SHAPES = {"oled": ("OLED", "an OLED"), "laser": ("laser", "a projector of lasers")}
REACH = 1e-4  # of a set's largest power


def written(name: str, words: str, rows: Iterable[tuple[float, ...]]) -> None:
    """A file of configs, from the first light to the last."""
    table = [*rows]
    least = REACH * max(max(row[1:]) for row in table)
    lit = [k for k, row in enumerate(table) if max(row[1:]) >= least]
    cut = [
        [nm, *(one if one > REACH * least else 0.0 for one in power)]
        for nm, *power in table[lit[0] : lit[-1] + 1]
    ]
    body = "".join(",".join(f"{value:.5g}" for value in row) + "\n" for row in cut)
    (CONFIGS / f"primaries-{name}.csv").write_text(f"# {words}\nwavelength_nm,r,g,b\n{body}")


def main() -> None:
    """Write all four."""
    import colour

    for name, (display, source) in MEASURED.items():
        one = colour.MSDS_DISPLAY_PRIMARIES[display]
        words = (
            f"{display}: primaries as measured, relative power per nm. {source}; colour-science"
            " 0.4.7 (PyPI, BSD-3-Clause)"
        )
        written(
            name,
            words,
            (
                (float(nm), *map(float, row))
                for nm, row in zip(one.wavelengths, one.values, strict=True)
            ),
        )
    for name, (panel, whose) in SHAPES.items():
        rows = zip(NM.tolist(), *(curve_of(lobes).tolist() for lobes in PANELS[panel]), strict=True)
        written(name, f"Not measured: Gaussians as wide as the primaries of {whose}", rows)


if __name__ == "__main__":
    main()
