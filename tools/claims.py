"""The matrix of claims: what holds each figure of README and docs.

`python tools/claims.py` writes docs/claims.md and README's sum from claims.toml. FILE is what tests
write that run with HILSTAR_CLAIMS=FILE (`holds` in tests/support/claims.py): `--renew FILE` first
takes last values and dates from it, `--check FILE` of a whole run writes nothing and names the
claims that it did not measure, or measured far below what was measured last.
"""

from __future__ import annotations

import argparse
import datetime
import json
import math
import re
import tomllib
from collections import Counter
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
ROWS, PAGE, README = "claims.toml", "docs/claims.md", "README.md"
PAGES = ("README.md", "docs/*.md")
# held by nothing outside hilstar, and by something
INSIDE = ("none", "own derivation")
OUTSIDE = ("closed form", "library", "public data", "independent program", "hardware")
KINDS = {"accuracy": "accuracy", "time": "times", "setting": "settings"}
AT_MOST, ABOUT = "at most", "about"
MIN_OUTSIDE_SHARE = 0.9  # of the rows that are neither times nor settings
# A figure that is an upper limit is not told twice as large as what was measured.
MIN_OF_LIMIT = 0.5
MAX_MARGIN = 0.05  # of the figure: a wider scatter is a range, "LOW to HIGH"
# A run that measures less than this of the last value measures something else.
MIN_OF_LAST = 0.5
MARK = re.compile(r"<!-- claim: ([\w.-]+) -->")
SUM = re.compile(r"(<!-- sum of claims -->)(.*?)(<!-- end -->)", re.DOTALL)
NUMBER = r"\d[\d ]*(?:\.\d+)?(?:e[-+]?\d+)?"
GENERATED = "Made by `python tools/claims.py` from `claims.toml`."


@dataclass(frozen=True)
class Claim:
    """A row: a figure as the pages write it, what it is held against, and by which test.

    `value` is one number, or "LOW to HIGH". `sense` says what a measured value may be: "at most"
    the figure, or "about" it. `margin` is the relative scatter between machines that is allowed on
    top of the figure's last digit, and `why` the reason for it, for an oracle inside, or for a
    limit that is wider than twice what was measured. `names` are what the test has to use of the
    oracle, `package` the distribution whose version counts.
    """

    id: str
    group: str
    what: str
    value: str
    unit: str
    oracle: str
    against: str
    test: str
    shares: str
    names: tuple[str, ...]
    last: float | str
    date: datetime.date
    kind: str = "accuracy"
    sense: str = AT_MOST
    margin: float = 0.0
    why: str = ""
    conditions: str = ""
    package: str = ""
    version: str = ""

    def bound(self) -> tuple[float, float]:
        """Between which values, inclusive, a measured one leaves the figure true."""
        ends = [self._widened(words) for words in self.value.split(" to ")]
        low = -math.inf if len(ends) == 1 and self.sense == AT_MOST else ends[0][0]
        return low, ends[-1][1]

    def _widened(self, words: str) -> tuple[float, float]:
        """A number by half of its last digit and by the margin, to either side."""
        value = float(words.replace(" ", ""))
        by = last_digit(words) / 2 + self.margin * abs(value)
        return value - by, value + by

    def lasts(self) -> list[float]:
        """What was measured last: one value, or the smallest and the largest."""
        return [float(words) for words in str(self.last).split(" to ")]

    def is_outside(self) -> bool:
        """Whether something that is not hilstar's own holds it."""
        return self.oracle in OUTSIDE

    def is_loose(self) -> bool:
        """Whether it is an upper limit over twice what was measured last."""
        if self.sense != AT_MOST or " to " in self.value:
            return False
        return max(self.lasts()) < MIN_OF_LIMIT * float(self.value.replace(" ", ""))

    def figure(self) -> str:
        """The value with its unit."""
        return f"{self.value} {self.unit}".strip()


@dataclass(frozen=True)
class Table:
    """A table that `results/tables.py` makes of `file`, and what its kind of figures is held
    against. A name that ends in "*" stands for all others that begin so.
    """

    name: str
    what: str
    file: str
    oracle: str
    against: str
    test: str
    shares: str
    names: tuple[str, ...] = ()

    def is_outside(self) -> bool:
        """Whether something that is not hilstar's own holds it."""
        return self.oracle in OUTSIDE


def last_digit(words: str) -> float:
    """What one step of a number's last digit is: 0.01 of "1.25", 1e-13 of "8.1e-12"."""
    mantissa, _, exponent = words.replace(" ", "").partition("e")
    places = len(mantissa.partition(".")[2])
    return float(10.0 ** (int(exponent or 0) - places))


def claims_of(root: Path = ROOT) -> list[Claim]:
    """The figures of claims.toml.

    Raises:
        ValueError: a key is unknown or missing, or an identifier stands twice.
    """
    claims = [Claim(**row) for row in rows_of("claim", Claim, root)]
    twice = [name for name, count in Counter(claim.id for claim in claims).items() if count > 1]
    if twice:
        raise ValueError(f"{ROWS}: {', '.join(twice)} stands twice")
    return claims


def tables_of(root: Path = ROOT) -> list[Table]:
    """The generated tables of claims.toml.

    Raises:
        ValueError: a key is unknown or missing.
    """
    return [Table(**row) for row in rows_of("table", Table, root)]


def rows_of(kind: str, record: type[Claim] | type[Table], root: Path) -> list[dict[str, Any]]:
    """The rows of a kind, with the keys that it has to have and no others."""
    with (root / ROWS).open("rb") as file:
        rows = tomllib.load(file).get(kind, [])
    keys = {field.name: field.default is MISSING for field in fields(record)}
    for row in rows:
        unknown = set(row) - set(keys)
        missing = {key for key, is_needed in keys.items() if is_needed} - set(row)
        if unknown or missing:
            name = row.get("id") or row.get("name")
            words = ", ".join(sorted(unknown | missing))
            raise ValueError(f"{ROWS}: {name}: unknown or missing: {words}")
    return [row | {"names": tuple(row.get("names", ()))} for row in rows]


def pages_of(root: Path = ROOT) -> dict[str, str]:
    """The text of each page that may have marks, by its path; the matrix itself has none."""
    paths = [path for pattern in PAGES for path in sorted(root.glob(pattern))]
    names = {path.relative_to(root).as_posix(): path for path in paths}
    return {name: path.read_text("utf-8") for name, path in names.items() if name != PAGE}


def sum_of(claims: list[Claim]) -> str:
    """What holds the figures, in one sentence."""
    figures = [claim for claim in claims if claim.kind == "accuracy"]
    oracles = Counter(claim.oracle for claim in figures)
    outside = ", ".join(f"{oracles[name]} {name}" for name in OUTSIDE if oracles[name])
    held = sum(claim.is_outside() for claim in figures)
    inside = ", ".join(f"{oracles[name]} {name}" for name in INSIDE if oracles[name])
    rest = f" ({inside})" if inside else ""
    return (
        f"Of {len(figures)} figures of accuracy {held} are compared with something outside hilstar"
        f" ({outside}), {len(figures) - held} not{rest}"
    )


def page(root: Path = ROOT) -> str:
    """docs/claims.md: the sum, and a row a claim by group."""
    claims, pages = claims_of(root), pages_of(root)
    places_of = {claim.id: pages_with(claim.id, pages) for claim in claims}
    counts = Counter(claim.kind for claim in claims)
    others = ", ".join(f"{counts[kind]} {KINDS[kind]}" for kind in ("time", "setting"))
    lines = [
        "# What holds each figure",
        "",
        f"<!-- {GENERATED} -->",
        "",
        f"{sum_of(claims)}. Besides, there are {others}.",
        "",
        "The test named fails where a measured value leaves the figure's last digit (a figure with"
        " ≤ is an upper limit; ± is the scatter between machines), `tests/docs/test_claims.py` where a page says another figure, or"
        " where the test does not use its oracle. *Last* is what it measured then.",
    ]
    for group in dict.fromkeys(claim.group for claim in claims):
        rows = [claim for claim in claims if claim.group == group]
        lines += ["", f"## {group}", ""]
        lines += ["| figure | of | oracle | shared with hilstar | test | last | on |"]
        lines += ["|---|---|---|---|---|---|---|"]
        lines += [line(claim, places_of[claim.id]) for claim in rows]
    lines += ["", "## Generated tables", ""]
    lines += ["Their figures are those of the files (`tests/docs/test_generated.py`).", ""]
    lines += ["| table | file | oracle | shared with hilstar | test |", "|---|---|---|---|---|"]
    for table in tables_of(root):
        places = [name for name, text in pages.items() if f"<!-- table: {table.name} -->" in text]
        linked = ", ".join(link(place) for place in places)
        of = f"{table.what} ({linked})" if places else table.what
        cells = [of, f"`{table.file}`", oracle_of(table), table.shares, test_of(table.test)]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def line(claim: Claim, places: list[str]) -> str:
    """A claim as a row of the table."""
    of = f"{claim.what}; {claim.conditions}" if claim.conditions else claim.what
    oracle = " ".join(filter(None, [oracle_of(claim), claim.version]))
    if claim.why:
        oracle += f" ({claim.why})"
    linked = ", ".join(link(place) for place in places)
    sense = "≤ " if claim.sense == AT_MOST and " to " not in claim.value else ""
    margin = f" ± {100 * claim.margin:g} %" if claim.margin else ""
    cells = [f"{sense}{claim.figure()}{margin}", f"{of} ({linked})", oracle, claim.shares]
    cells += [test_of(claim.test), str(claim.last), claim.date.isoformat()]
    return f"| {' | '.join(cells)} |"


def oracle_of(row: Claim | Table) -> str:
    """The kind of oracle, and which."""
    return f"{row.oracle}: {row.against}" if row.against else row.oracle


def test_of(test: str) -> str:
    """A test by its file and its name."""
    path, _, name = test.partition("::")
    return f"`{Path(path).name}::{name}`" if test else "-"


def link(place: str) -> str:
    """A page as the matrix names it; README is no page of the site."""
    name = Path(place).name
    return Path(place).stem if place == README else f"[{Path(place).stem}]({name})"


def pages_with(claim: str, pages: dict[str, str]) -> list[str]:
    """The pages that have a claim's mark."""
    return [name for name, text in pages.items() if f"<!-- claim: {claim} -->" in text]


def with_sum(text: str, claims: list[Claim]) -> str:
    """README with the sum between its marks."""
    words = f"{sum_of(claims)}: [claims](docs/claims.md)."
    return SUM.sub(lambda found: f"{found[1]}{words}{found[3]}", text)


def renewed(text: str, records: list[dict[str, str]], today: datetime.date) -> str:
    """claims.toml with the values of a run: of several values of a claim the largest, or both ends
    where its value is a range.
    """
    values: dict[str, list[float]] = {}
    versions: dict[str, str] = {}
    for record in records:
        values.setdefault(record["claim"], []).append(float(record["value"]))
        versions[record["claim"]] = record["version"]
    blocks = re.split(r"(?m)^(?=\[\[claim\]\])", text)
    for number, block in enumerate(blocks):
        found = re.search(r'(?m)^id = "([^"]+)"', block)
        if found is None or found[1] not in values:
            continue
        measured = values[found[1]]
        is_range = re.search(r'(?m)^value = "[^"]* to ', block) is not None
        last = f"{max(measured):.3g}"
        if is_range:
            last = f'"{min(measured):.3g} to {last}"'
        block = re.sub(r"(?m)^last = .*$", f"last = {last}", block)
        block = re.sub(r"(?m)^date = .*$", f"date = {today.isoformat()}", block)
        if versions[found[1]]:
            block = re.sub(r"(?m)^version = .*$", f'version = "{versions[found[1]]}"', block)
        blocks[number] = block
    return "".join(blocks)


def records_of(path: Path) -> list[dict[str, str]]:
    """What tests recorded."""
    return [json.loads(record) for record in path.read_text("utf-8").splitlines()]


def strayed(claims: list[Claim], records: list[dict[str, str]]) -> list[str]:
    """What a whole run did not measure, or measured far below the last value: what a test hands
    over, or its oracle, is then another.
    """
    values: dict[str, list[float]] = {}
    for record in records:
        values.setdefault(record["claim"], []).append(float(record["value"]))
    found = []
    for claim in claims:
        if not claim.test:
            continue
        last = max(claim.lasts())
        if claim.id not in values:
            found.append(f"{claim.id}: {claim.test} did not measure it")
        elif claim.kind != "accuracy" or claim.is_loose():
            continue  # of a limit that is far off, any run may be further off
        elif max(values[claim.id]) < MIN_OF_LAST * last:
            found.append(f"{claim.id}: {max(values[claim.id]):.3g}, and {last:.3g} before")
    return found


def main() -> None:
    """Write the page and the sum, or check a run. Raises SystemExit where it strayed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", type=Path, metavar="FILE", help="what HILSTAR_CLAIMS recorded")
    parser.add_argument("--renew", type=Path, metavar="FILE", help="what HILSTAR_CLAIMS recorded")
    given = parser.parse_args()
    if given.check is not None:
        found = strayed(claims_of(), records_of(given.check))
        raise SystemExit("\n".join(found) if found else None)
    if given.renew is not None:
        records = records_of(given.renew)
        path = ROOT / ROWS
        text = path.read_text("utf-8")
        path.write_text(renewed(text, records, datetime.date.today()), "utf-8")
    readme = ROOT / README
    readme.write_text(with_sum(readme.read_text("utf-8"), claims_of()), "utf-8")
    (ROOT / PAGE).write_text(page(), "utf-8")


if __name__ == "__main__":
    main()
