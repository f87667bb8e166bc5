"""Make the curves of quantum efficiency of sensors by name: hilstar/sky/data/NAME.csv.

    python tools/make_sensors.py CLONE/cfg/sensors
    python tools/make_sensors.py        (prints the table of docs/twin.md)

CLONE is one of gidobot/UWOpticalSystemsDesignTools on GitHub (MIT). Its IMX178 is left out: two of
its points (955 and 1027 nm) lack a zero. The other figures of a sensor are typed into
hilstar/tracker/sensors.toml, which names their sources.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from hilstar.sky.spectrum import read_curve_csv
from hilstar.tracker.sensors import Sensor, sensors

DATA = Path(__file__).resolve().parents[1] / "hilstar" / "sky" / "data"
SENSORS = {
    "icx285": "icx285ALM.json",
    "imx249": "imx249M.json",
    "imx250": "imx250M.json",
    "imx252": "imx252M.json",
}


def curve(name: str, text: str) -> str:
    """A sensor's curve as hilstar reads it, from the JSON of that repository."""
    sheet = json.loads(text)
    points = zip(sheet["quantum_efficiency_wavelengths"], sheet["quantum_efficiency"], strict=True)
    shares = {f"{nm:.1f}": share for nm, share in points}
    rows = sorted(shares.items(), key=lambda row: float(row[0]))
    body = "".join(f"{nm},{share:.4f}\n" for nm, share in rows)
    source = "the maker's response digitised in gidobot/UWOpticalSystemsDesignTools"
    head = f"# {name.upper()}, monochrome, quantum efficiency:\n# {source} (MIT, 2020-04-14)\n"
    return f"{head}wavelength_nm,value\n{body}"


def table() -> str:
    """The table of docs/twin.md: what the sheets say, and where that is from."""
    lines = ["| sensor | known | quantum efficiency | source |", "|---|---|---|---|"]
    for sensor in sensors().values():
        keys = [*sensor.tracker, *sensor.detector]
        figures = [f"`{key}`" for key in keys if key != "quantum_efficiency"]
        lines.append(
            f"| `{sensor.name}` | {', '.join(figures)} | {_sampled(sensor)} | {sensor.source} |"
        )
    return "\n".join(lines)


def _sampled(sensor: Sensor) -> str:
    """At how many wavelengths a sensor's efficiency is known, and from where to where."""
    if "quantum_efficiency" in sensor.tracker:
        nm = read_curve_csv(DATA / f"{sensor.name}.csv").wavelength_nm
        return f"{len(nm)} wavelengths, {nm[0]:g} to {nm[-1]:g} nm"
    points = [f"{share:g} at {nm:g} nm" for nm, share in sensor.efficiency]
    return ", ".join(points) or "not known"


def main() -> None:
    """Write the packaged files, or print the table."""
    if len(sys.argv) == 1:
        print(table())
        return
    folder = Path(sys.argv[1])
    for name, file in SENSORS.items():
        (DATA / f"{name}.csv").write_text(curve(name, (folder / file).read_text()))


if __name__ == "__main__":
    main()
