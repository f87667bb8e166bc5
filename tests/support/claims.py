"""What holds the figures of the pages: a test hands its measured value to `holds`, and the rules
find a figure, a row of claims.toml and a test that do not belong together.
"""

from __future__ import annotations

import ast
import datetime
import importlib.metadata
import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import cache
from pathlib import Path

from tests.support.benches import ROOT
from tools.claims import (
    ABOUT,
    AT_MOST,
    INSIDE,
    KINDS,
    MARK,
    MAX_MARGIN,
    MIN_OUTSIDE_SHARE,
    NUMBER,
    OUTSIDE,
    ROWS,
    Claim,
    Table,
    claims_of,
    pages_of,
    tables_of,
)

RECORDS = "HILSTAR_CLAIMS"
# On each page each figure with an accuracy's unit has its mark, but on those that a script makes
UNMARKED_PAGES = ("docs/bench-file.md", "docs/commands.md", "docs/python-api.md")
LEVEL = ["95", "%"]  # of intervals and quantiles: no accuracy
# Behind an input, a limit or another's figure, which was not measured: the file that has it, and a
# word of its line there: any small number stands somewhere in a file
GIVEN = re.compile(r"<!-- given: ([\w./-]+)(?:::(\w+))? -->")
FIGURE = re.compile(rf"(?<![\w.-])({NUMBER})\s?(arcsec|mas|px|mag|%)(?![\w/])")
# what is no prose: blocks of code, tables that a script makes, code in a line
NO_PROSE = re.compile(
    r"^```.*?^```$|<!-- table: \w+ -->.*?<!-- end -->|`[^`\n]*`", re.MULTILINE | re.DOTALL
)
STATED = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.]*\w)")
LAST_ROUNDED = 0.005  # last values have three digits
TABLE = re.compile(r"<!-- table: (\w+) -->")
IMPORTED = re.compile(r"^ *(?:from|import) (\w+)", re.MULTILINE)


@cache
def rows() -> dict[str, Claim]:
    """The rows of this checkout, by identifier."""
    return {claim.id: claim for claim in claims_of()}


def holds(claim: str, value: float) -> None:
    """Fail unless a measured value leaves the figure of a claim true.

    With HILSTAR_CLAIMS=FILE in the environment the value is added to FILE, of which `python
    tools/claims.py --renew FILE` writes the last values of claims.toml.
    """
    row, measured = rows()[claim], float(value)
    low, high = row.bound()
    record(row, measured)
    assert low <= measured <= high, (
        f"{claim}: measured {measured:.6g}; the pages say {row.sense} {row.figure()},"
        f" which holds from {low:.6g} to {high:.6g}"
    )


def record(row: Claim, measured: float) -> None:
    """Add a value to the file of records, where one is asked for."""
    path = os.environ.get(RECORDS)
    if not path:
        return
    version = importlib.metadata.version(row.package) if row.package else ""
    entry = {"claim": row.id, "value": f"{measured:.6g}", "version": version}
    with Path(path).open("a", encoding="utf-8") as file:
        file.write(json.dumps(entry) + "\n")


def faults(root: Path = ROOT) -> list[str]:
    """All that is wrong with the claims of a checkout, a line each."""
    claims = claims_of(root)
    pages = pages_of(root)
    found = [*faults_of_marks(claims, pages), *unmarked_figures(pages, root)]
    uses: dict[str, Uses] = {}
    for claim in claims:
        found += faults_of_row(claim)
        found += faults_of_test(claim, root, uses)
    found += faults_of_tables(tables_of(root), pages, root)
    figures = [claim for claim in claims if claim.kind == "accuracy"]
    outside = sum(claim.is_outside() for claim in figures)
    if outside < MIN_OUTSIDE_SHARE * len(figures):
        found.append(f"{ROWS}: {outside} of {len(figures)} figures have an outside oracle")
    return found


def faults_of_marks(claims: list[Claim], pages: dict[str, str]) -> list[str]:
    """Marks without a row or beside another figure, and rows without a mark."""
    by_id = {claim.id: claim for claim in claims}
    marked: set[str] = set()
    found = []
    for name, text in pages.items():
        for mark in MARK.finditer(text):
            place = f"{name}:{text.count(chr(10), 0, mark.start()) + 1}"
            claim = by_id.get(mark[1])
            if claim is None:
                found.append(f"{place}: no row of {ROWS} is {mark[1]}")
                continue
            marked.add(claim.id)
            before = " ".join(MARK.sub("", text[: mark.start()][-400:]).split())
            if not says(before, claim):
                found.append(
                    f"{place}: {mark[1]} is {claim.figure()}, the page has ...{before[-30:]}"
                )
    found += [f"{ROWS}: {name} stands on no page" for name in by_id if name not in marked]
    return found


def faults_of_tables(tables: list[Table], pages: dict[str, str], root: Path) -> list[str]:
    """Generated tables without a row, rows without a table, and rows whose test is not there or
    does not use the oracle.
    """
    shown = {name for text in pages.values() for name in TABLE.findall(text)}
    names = {table.name for table in tables}
    others = [name for name in names if name.endswith("*")]  # programs that are run on demand
    unknown = {name for name in shown - names if not fnmatches(name, others)}
    found = [f"{ROWS}: no row of the table {name}" for name in sorted(unknown)]
    missing = names - shown - set(others)
    found += [f"{ROWS}: the table {name} is on no page" for name in sorted(missing)]
    for table in tables:
        place = f"{ROWS}: table {table.name}: {table.test}"
        path, _, name = table.test.partition("::")
        if not table.test and (not table.is_outside() or table.name in others):
            continue
        if not (root / path).is_file() or name not in definitions(root / path):
            found.append(f"{place} does not exist")
            continue
        uses = uses_of(root / path, name, root)
        unused = [word for word in table.names if not uses.has(word)]
        if unused:
            found.append(f"{place} does not use {', '.join(unused)}")
        if table.is_outside() and not (table.against and table.names):
            found.append(f"{place}: nothing says what the test uses of the oracle")
    return found


def fnmatches(name: str, patterns: list[str]) -> bool:
    """Whether a name is one of those that the patterns stand for."""
    return any(fnmatch(name, pattern) for pattern in patterns)


def says(before: str, claim: Claim) -> bool:
    """Whether a text ends in a claim's figure, with its unit or without."""
    value = re.escape(claim.value)
    unit = re.escape(claim.unit)
    return re.search(rf"(?<![\w.-]){value}(?: {unit})?\**$", before) is not None


def unmarked_figures(pages: dict[str, str], root: Path) -> list[str]:
    """Figures with an accuracy's unit in the prose of pages that have no mark, or are marked as given
    and do not stand in the file named.
    """
    found = []
    for name in sorted(pages.keys() - set(UNMARKED_PAGES)):
        prose = NO_PROSE.sub(lambda part: re.sub(r"[^\n]", " ", part[0]), pages[name])
        figures = (part for part in FIGURE.finditer(prose) if part[0].split() != LEVEL)
        for figure in figures:
            place = f"{name}:{prose.count(chr(10), 0, figure.start()) + 1}"
            words = " ".join(figure[0].split())
            given = GIVEN.match(prose, figure.end())
            if given is not None and not given[2]:
                found.append(f"{place}: {given[1]} without a word of its line: FILE::WORD")
            elif given is not None and not has_figure(root / given[1], given[2], figure):
                found.append(f"{place}: {given[1]} has no {words} beside {given[2]}")
            elif given is None and not MARK.match(prose, figure.end()):
                found.append(f"{place}: {words} has no mark")
    return found


def has_figure(path: Path, word: str, figure: re.Match[str]) -> bool:
    """Whether a figure's number stands in a file's line with a word; a percentage may stand there
    as a share, which may be one over or under 1.
    """
    if not path.is_file():
        return False
    value = float(figure[1].replace(" ", ""))
    share = value / 100
    wanted = {value, share, 1 + share, 1 - share} if figure[2] == "%" else {value}
    lines = [line for line in path.read_text("utf-8").splitlines() if word in line]
    numbers = [float(words) for line in lines for words in STATED.findall(line)]
    return any(math.isclose(number, one) for number in numbers for one in wanted)


def faults_of_row(claim: Claim) -> list[str]:
    """What is wrong with a row by itself."""
    low, high = claim.bound()
    lasts = claim.lasts()
    largest = max(lasts)
    rounding = LAST_ROUNDED * abs(largest)
    rules = {
        f"the kind is none of {', '.join(KINDS)}": claim.kind in KINDS,
        "the oracle is of no known kind": claim.oracle in (*INSIDE, *OUTSIDE),
        "the sense is neither 'at most' nor 'about'": claim.sense in (AT_MOST, ABOUT),
        f"the last value {claim.last} is out of {low:.4g} to {high:.4g}": (
            low - rounding <= min(lasts) and largest <= high + rounding
        ),
        f"the last value {claim.last} is under half of {claim.figure()}, and no `why` says so": (
            not claim.is_loose() or bool(claim.why)
        ),
        "no `why` says why nothing outside holds it": (
            claim.kind != "accuracy" or claim.is_outside() or bool(claim.why)
        ),
        "no `why` says why it has a margin": not claim.margin or bool(claim.why),
        f"the margin is over {MAX_MARGIN:g}": claim.margin <= MAX_MARGIN,
        "nothing says what it is held against": not claim.is_outside() or bool(claim.against),
        "nothing says what the test uses of the oracle": (
            not claim.is_outside() or bool(claim.names)
        ),
        "nothing says what the oracle shares with hilstar": bool(claim.shares),
        f"its date {claim.date} is to come": claim.date <= datetime.date.today(),
    }
    return [f"{ROWS}: {claim.id}: {rule}" for rule, is_kept in rules.items() if not is_kept]


@dataclass(frozen=True)
class Uses:
    """What a test has, with all that it reaches: the values handed to `holds`, words, texts with
    values in them as regular expressions, imported packages, and whether it asserts a bound of its
    own.
    """

    values: list[ast.expr]
    words: set[str]
    patterns: list[str]
    imports: set[str]
    has_own_bound: bool

    def has(self, word: str) -> bool:
        """Whether a word stands in one of the test's."""
        return any(word in other for other in self.words)

    def names_claim(self, claim: str) -> bool:
        """Whether the claim's name stands in the test."""
        return claim in self.words or any(re.fullmatch(text, claim) for text in self.patterns)


def uses_of(path: Path, name: str, root: Path) -> Uses:
    """What a test function of a file has."""
    nodes = reached(path, name, root)
    return Uses(
        [call.args[1] for node in nodes for call in calls_of_holds(node)],
        {word for node in nodes for word in words_of(node)},
        [pattern for node in nodes for pattern in patterns_of(node)],
        {module for node in nodes for module in imports_of(node)},
        any(own_bounds(node) for node in nodes),
    )


def faults_of_test(claim: Claim, root: Path, known: dict[str, Uses]) -> list[str]:
    """What is wrong with a row's test: it is not there, hands no value to `holds`, has a bound of
    its own, or does not use the oracle. `known` tests are not read again.
    """
    place = f"{ROWS}: {claim.id}: {claim.test}"
    if not claim.test:
        return [] if claim.oracle == "none" else [f"{place}no test holds it"]
    path, _, name = claim.test.partition("::")
    if not (root / path).is_file() or name not in definitions(root / path):
        return [f"{place} does not exist"]
    if claim.test not in known:
        known[claim.test] = uses_of(root / path, name, root)
    uses = known[claim.test]
    unused = [word for word in claim.names if not uses.has(word)]
    rules = {
        "does not hand a value to holds": bool(uses.values) and uses.names_claim(claim.id),
        "hands a constant to holds": not any(is_constant(value) for value in uses.values),
        "has a bound of its own for what holds is given": not uses.has_own_bound,
        f"does not use {', '.join(unused)}": not unused,
    }
    found = [f"{place} {rule}" for rule, is_kept in rules.items() if not is_kept]
    if claim.oracle == "library":
        found += faults_of_library(claim, uses.imports)
    return found


def faults_of_library(claim: Claim, imported: set[str]) -> list[str]:
    """A library that the test does not import, or that hilstar uses though the row says that they
    share nothing.
    """
    distributions = distributions_by_module()
    modules = {name for name, owners in distributions.items() if claim.package in owners}
    if not modules & imported:
        return [f"{ROWS}: {claim.id}: {claim.test} does not import {claim.package or 'a library'}"]
    if modules & hilstars_imports() and claim.shares == "nothing":
        return [f"{ROWS}: {claim.id}: hilstar imports {claim.package} too: say what it shares"]
    return []


@cache
def distributions_by_module() -> Mapping[str, list[str]]:
    """The distributions that each importable package comes from."""
    return importlib.metadata.packages_distributions()


@cache
def hilstars_imports() -> frozenset[str]:
    """The top-level packages that hilstar imports."""
    texts = (path.read_text("utf-8") for path in (ROOT / "hilstar").rglob("*.py"))
    return frozenset(name for text in texts for name in IMPORTED.findall(text))


def definitions(path: Path) -> dict[str, ast.AST]:
    """What a module's top level defines or imports, by name."""
    return _definitions(path.read_text("utf-8"))


@cache
def _definitions(text: str) -> dict[str, ast.AST]:
    found: dict[str, ast.AST] = {}
    for node in ast.parse(text).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found[node.name] = node
        elif isinstance(node, ast.Import | ast.ImportFrom):
            found |= {alias.asname or alias.name.split(".")[0]: node for alias in node.names}
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = (name for target in targets for name in ast.walk(target))
            found |= {name.id: node for name in names if isinstance(name, ast.Name)}
    return found


def reached(path: Path, name: str, root: Path) -> list[ast.AST]:
    """A test, and all of its module and of other tests' that it uses: functions, fixtures,
    constants and imports.
    """
    found: list[ast.AST] = []
    waiting, visited = [(path, name)], set()
    defined: dict[Path, dict[str, ast.AST]] = {}
    while waiting:
        module, word = waiting.pop()
        if module not in defined:
            defined[module] = definitions(module)
        node = defined[module].get(word)
        if node is None or (module, word) in visited:
            continue
        visited.add((module, word))
        found.append(node)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("tests"):
            other = root / f"{(node.module or '').replace('.', '/')}.py"
            if other.is_file() and other != Path(__file__) and other.name != "claims.py":
                waiting.append((other, word))
        elif not isinstance(node, ast.Import | ast.ImportFrom):
            waiting += [(module, other) for other in names_of(node)]
    return found


# A definition whose file is as it was is the same node: each is looked through once a process.
@cache
def names_of(node: ast.AST) -> set[str]:
    """The names that a definition uses, its arguments included, which may be fixtures."""
    nodes = list(ast.walk(node))
    used = {part.id for part in nodes if isinstance(part, ast.Name)}
    return used | {part.arg for part in nodes if isinstance(part, ast.arg)}


@cache
def words_of(node: ast.AST) -> list[str]:
    """Identifiers, texts and imported names in a definition."""
    found: list[str] = []
    for part in ast.walk(node):
        if isinstance(part, ast.Name):
            found.append(part.id)
        elif isinstance(part, ast.Attribute):
            found.append(part.attr)
        elif isinstance(part, ast.alias):
            found.append(part.name)
        elif isinstance(part, ast.ImportFrom):
            found.append(part.module or "")
        elif isinstance(part, ast.Constant) and isinstance(part.value, str):
            found.append(part.value)
        elif isinstance(part, ast.FunctionDef):
            found.append(part.name)
    return found


@cache
def patterns_of(node: ast.AST) -> list[str]:
    """The texts with values in them (f"name-{bits}"), as regular expressions."""
    found = []
    for part in ast.walk(node):
        if isinstance(part, ast.JoinedStr):
            pieces = (
                re.escape(str(value.value)) if isinstance(value, ast.Constant) else r"[\w.-]+"
                for value in part.values
            )
            found.append("".join(pieces))
    return found


@cache
def imports_of(node: ast.AST) -> set[str]:
    """The top-level packages that a definition imports."""
    found: set[str] = set()
    for part in ast.walk(node):
        if isinstance(part, ast.Import):
            found |= {alias.name.split(".")[0] for alias in part.names}
        elif isinstance(part, ast.ImportFrom) and not part.level:
            found.add((part.module or "").split(".")[0])
        elif isinstance(part, ast.Call) and ast.unparse(part.func) == "pytest.importorskip":
            found.add(ast.literal_eval(part.args[0]).split(".")[0])
    return found


@cache
def calls_of_holds(node: ast.AST) -> list[ast.Call]:
    """The calls of `holds` in a definition."""
    calls = [part for part in ast.walk(node) if isinstance(part, ast.Call)]
    return [
        call
        for call in calls
        if isinstance(call.func, ast.Name) and call.func.id == "holds" and len(call.args) == 2
    ]


def is_constant(node: ast.expr) -> bool:
    """Whether an expression has no name in it: nothing was measured."""
    return not any(isinstance(part, ast.Name) for part in ast.walk(node))


@cache
def own_bounds(node: ast.AST) -> bool:
    """Whether a test asserts another bound, a constant, of what it hands to `holds`."""
    given = {ast.dump(call.args[1]) for call in calls_of_holds(node)}
    asserted = [part for part in ast.walk(node) if isinstance(part, ast.Assert)]
    compared = [part for one in asserted for part in ast.walk(one) if isinstance(part, ast.Compare)]
    for part in compared:
        sides = [part.left, *part.comparators]
        others = [side for side in sides if ast.dump(side) not in given]
        if len(others) < len(sides) and any(is_limit(side) for side in others):
            return True
    return False


def is_limit(node: ast.expr) -> bool:
    """Whether an expression is a number or a constant of a module."""
    names = [part.id for part in ast.walk(node) if isinstance(part, ast.Name)]
    return all(name.isupper() for name in names)
