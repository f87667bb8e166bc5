"""Run hilstar beside an independent program: `python tools/beside.py NAME -o DIR`.

DIR gets beside_NAME.csv and the chart beside_NAME. docs/beside.md is made of results/beside_*.csv
by results/tables.py.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from datetime import UTC, datetime
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from hilstar.basics.errors import HilstarError
from tests.support.beside.steps import write_beside

# What each needs that `pip install -e '.[dev]'` does not bring.
PROGRAMS = {
    "galsim": "",
    "astrometry": "Debian's astrometry.net",
    "lost": "UWCubeSat/lost, built, its folder as the environment's LOST",
    "basilisk": "",
    "pyxel": "pyxel-sim in an environment of its own, whose Python is the environment's PYXEL",
    "satsim": "satsim in an environment of its own, whose Python is the environment's SATSIM",
    "stellarium": "Debian's stellarium, xvfb and xauth",
}


def main() -> None:
    """Run a program and write its table and its chart."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    needs = "; ".join(f"{name}: {need}" for name, need in PROGRAMS.items() if need)
    parser.add_argument("name", choices=PROGRAMS, help=needs)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    given = parser.parse_args()
    side = importlib.import_module(f"tests.support.beside.{given.name}_side")
    given.output.mkdir(parents=True, exist_ok=True)
    try:
        beside = side.run(given.output)
    except HilstarError as error:
        sys.exit(f"{given.name}: {error}")
    write_beside(given.output, given.name, beside, datetime.now(UTC).date().isoformat())
    for one in beside.steps:
        print(f"{one.subject}: {one.step}: {one.size:.3g} ({one.unit})")
    print(f"{beside.finding}\ntable and chart in {given.output}")


if __name__ == "__main__":
    main()
