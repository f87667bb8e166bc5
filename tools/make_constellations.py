"""Make `hilstar/sky/data/constellations.csv`: the boundaries of the constellations, from the data
files of Astropy.

Roman 1987 (PASP 99, 695; CDS VI/42) divides the sky of equinox B1875 into zones, in which
Delporte's boundaries run along circles of right ascension and declination: the first row that holds
a place names its constellation.
"""

import csv
from pathlib import Path

import astropy
import astropy.coordinates

DATA = Path(astropy.coordinates.__file__).parent / "data"
TARGET = Path(__file__).resolve().parents[1] / "hilstar" / "sky" / "data" / "constellations.csv"


def main() -> None:
    """Write the file."""
    lines = (DATA / "constellation_names.dat").read_text(encoding="utf-8").splitlines()
    names = {line[:3]: line[4:].strip() for line in lines if line and not line.startswith("#")}
    rows = [
        line.split() for line in (DATA / "constellation_data_roman87.dat").read_text().splitlines()
    ]
    with TARGET.open("w", encoding="utf-8", newline="") as file:
        file.write(
            "# Zones of the constellations, equinox B1875: hours of right ascension, lowest"
            " declination in degrees\n"
        )
        file.write(
            "# Roman 1987 (PASP 99, 695; CDS VI/42), from the data files of Astropy (BSD-3); made"
            " by make_constellations.py\n"
        )
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("from_h", "to_h", "lowest_deg", "name"))
        for row in rows:
            if len(row) == 4 and row[3] in names:
                writer.writerow((*row[:3], names[row[3]]))


if __name__ == "__main__":
    main()
