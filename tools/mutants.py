"""What README's test command holds: faults drawn by chance, one at a time, and which of them it
finds.

    python tools/mutants.py --mutants 60 --seed 1 -o DIR

Each mutant is one change of one expression in a core room, in a copy of the checkout. DIR gets
mutants.csv: the change, and the test that fails ("" where none does). A run that is stopped goes on
where it was. Some mutants are no fault (a limit of memory that is one byte larger): the share that
is found is a lower bound.
"""

from __future__ import annotations

import argparse
import ast
import copy
import csv
import os
import random
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path

ROOT = Path(__file__).parent.parent
ROOMS = ("sky", "optics", "display", "attitude", "tracker", "server/loop.py")
# A mutant that never ends is found, too: an unchanged checkout takes a tenth of it when idle.
MAX_RUN_S = 1800
HANGS = "it does not end"
FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)
NEAR = "HILSTAR_NEAR"  # the environment variable of tests/support/near_first.py

COMPARED: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
COMPUTED: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Pow: ast.Mult,
}


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change: the file, its line, the expression before and after."""

    path: str
    line: int
    before: str
    after: str
    start_byte: int
    end_byte: int


@dataclass(frozen=True, slots=True)
class Outcome:
    """A row of mutants.csv; `test` is the first that fails, "" where none does."""

    path: str
    line: int
    before: str
    after: str
    test: str
    wall_s: float


def changed(node: ast.AST) -> ast.AST | None:
    """The node with one fault; None where it is of no kind that is changed."""
    mutant = copy.deepcopy(node)
    match mutant:
        case ast.Compare(ops=[comparison]) if type(comparison) in COMPARED:
            mutant.ops = [COMPARED[type(comparison)]()]
        case ast.BinOp(op=operator, left=left) if type(operator) in COMPUTED:
            is_text = isinstance(left, (ast.Constant, ast.JoinedStr)) and not _is_number(left)
            if is_text:
                return None
            mutant.op = COMPUTED[type(operator)]()
        case ast.AugAssign(op=operator) if type(operator) in COMPUTED:
            mutant.op = COMPUTED[type(operator)]()
        case ast.BoolOp(op=ast.And()):
            mutant.op = ast.Or()
        case ast.BoolOp(op=ast.Or()):
            mutant.op = ast.And()
        case ast.UnaryOp(op=ast.USub() | ast.Not(), operand=operand):
            return operand
        case ast.Constant(value=bool() | int() | float() as value):
            mutant.value = other_number(value)
        case ast.Expr(value=ast.Call()):
            return ast.Pass()
        case _:
            return None
    return mutant


def other_number(value: bool | int | float) -> bool | int | float:
    """Another value of the same type."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value + 1
    return value * 1.1 or 1.0


def _is_number(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, (int, float))


def changeable(tree: ast.AST) -> Iterator[ast.AST]:
    """The nodes of a module but those that no run evaluates: annotations, and imports for types."""
    for name, value in ast.iter_fields(tree):
        if name in {"annotation", "returns", "decorator_list", "type_params"}:
            continue
        for child in value if isinstance(value, list) else [value]:
            # Python 3.11 does not know where the parts of an f-string stand.
            if not isinstance(child, ast.AST) or isinstance(child, ast.JoinedStr):
                continue
            if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
                continue
            yield child
            yield from changeable(child)


def mutants_of(path: Path) -> list[Mutant]:
    """Every mutant of a file."""
    source = path.read_bytes()
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    mutants: list[Mutant] = []
    for node in changeable(ast.parse(source)):
        mutant = changed(node)
        if mutant is None or not isinstance(node, (ast.expr, ast.stmt)):
            continue
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        start_byte = starts[node.lineno - 1] + node.col_offset
        end_byte = starts[node.end_lineno - 1] + node.end_col_offset
        after = ast.unparse(mutant)
        if isinstance(mutant, ast.expr):
            after = f"({after})"
        before = ast.unparse(node)
        name = str(path.relative_to(ROOT))
        mutants.append(Mutant(name, node.lineno, before, after, start_byte, end_byte))
    return mutants


def drawn(count: int, seed: int) -> list[Mutant]:
    """Mutants by chance, each of a core room's as probable as any other."""
    mutants: list[Mutant] = []
    for room in ROOMS:
        place = ROOT / "hilstar" / room
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            mutants += mutants_of(path)
    print(f"{len(mutants)} mutants in all", flush=True)
    return random.Random(seed).sample(mutants, count)


def copy_checkout(folder: Path) -> None:
    """The tracked files, in `folder`."""
    archive = subprocess.run(
        ["git", "archive", "--format=tar", "HEAD"], cwd=ROOT, check=True, capture_output=True
    )
    subprocess.run(["tar", "-x", "-C", folder], input=archive.stdout, check=True)


def outcome_of(mutant: Mutant, checkout: Path) -> Outcome:
    """The mutant in the copy, README's tests, and the file as it was."""
    path = checkout / mutant.path
    source = path.read_bytes()
    changed_source = source[: mutant.start_byte] + mutant.after.encode() + source[mutant.end_byte :]
    path.write_bytes(changed_source)
    module = mutant.path.removesuffix(".py").replace("/", ".")
    environment = os.environ | {"PYTHONPATH": str(checkout), NEAR: module}
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n0", "-p", "tests.support.near_first"]
    begun_s = time.monotonic()
    try:
        tests = subprocess.run(
            command,
            cwd=checkout,
            env=environment,
            capture_output=True,
            text=True,
            timeout=MAX_RUN_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        test = HANGS
    else:
        failed = FAILED.search(tests.stdout)
        if tests.returncode == 0:
            test = ""
        elif failed is None:
            test = tests.stdout.strip().splitlines()[-1] if tests.stdout.strip() else "no output"
        else:
            test = failed[1]
    finally:
        path.write_bytes(source)
    wall_s = time.monotonic() - begun_s
    return Outcome(mutant.path, mutant.line, mutant.before, mutant.after, test, round(wall_s, 1))


def main() -> None:
    """Draw, change, test; say the share that is found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mutants", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("-o", dest="output", type=Path, required=True)
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    table = options.output / "mutants.csv"
    done = 0
    if table.exists():
        with table.open(encoding="utf-8") as rows:
            done = len(list(csv.DictReader(rows)))
    else:
        table.write_text(",".join(field.name for field in fields(Outcome)) + "\n", encoding="utf-8")
    with tempfile.TemporaryDirectory() as temporary:
        checkout = Path(temporary)
        copy_checkout(checkout)
        for mutant in drawn(options.mutants, options.seed)[done:]:
            outcome = outcome_of(mutant, checkout)
            with table.open("a", encoding="utf-8", newline="") as rows:
                csv.writer(rows).writerow(asdict(outcome).values())
            print(outcome, flush=True)
    with table.open(encoding="utf-8") as rows:
        tests = [row["test"] for row in csv.DictReader(rows)]
    held = sum(bool(test) for test in tests)
    print(f"{held} of {len(tests)} are found, {100 * held / len(tests):.0f} %")


if __name__ == "__main__":
    main()
