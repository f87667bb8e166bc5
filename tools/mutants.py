"""What README's test command holds: faults drawn by chance, one at a time, and which of them it
finds.

    HILSTAR_LINE_MAP=MAP pytest -n0 -p tests.support.line_map
    python tools/mutants.py --mutants 140 --seed 2 --by-lines MAP --near -o DIR
    python tools/mutants.py --mutants 40 --rooms attitude/logs server/loop.py -o DIR
    python tools/mutants.py --planted tools/planted_faults.toml --by-lines MAP -o DIR

Each mutant is one change in a core room, or in those of --rooms: one expression, one call, check or
limit that is left out, or two arguments that are swapped. DIR gets mutants.csv: the change, and the
test that fails with it and passes without it ("" where none does). A run that is stopped goes on
where it was. With --by-lines those of README's tests run that run the changed line, fastest first,
and with --near besides, where none of them fails, those whose files name the changed module or its
room; without a map these alone. Tests in processes of their own do not see the change: the share
that is found is a lower bound, also because some mutants are no fault (a limit of memory that is
one byte larger). --planted takes its changes from a file of faults that were thought of, and --rest
the tests that README's command leaves out.
"""

from __future__ import annotations

import argparse
import ast
import copy
import csv
import json
import os
import random
import sys
import time
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

# One process a core is enough, and threads would not survive a fork. Before NumPy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.support.faults.fault_runs import ROOT, ChangedFile, Session, dotted_name, with_tests

ROOMS = ("sky", "optics", "display", "attitude", "tracker", "server/loop.py")
# The tests of a line that are run: few faults that the fastest pass are found by slower ones.
MAX_TESTS_OF_LINE_S = 30.0

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
# what gives its argument without its sign, and its first one within limits
SIGNLESS = frozenset({"abs", "np.abs"})
LIMITING = frozenset({"max", "min", "np.clip", "np.fmax", "np.fmin", "np.maximum", "np.minimum"})


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
    if isinstance(mutant, ast.stmt):
        return changed_statement(mutant)
    match mutant:
        case ast.Compare(ops=[comparison]) if type(comparison) in COMPARED:
            mutant.ops = [COMPARED[type(comparison)]()]
        case ast.BinOp(op=operator, left=left) if type(operator) in COMPUTED:
            is_text = isinstance(left, (ast.Constant, ast.JoinedStr)) and not _is_number(left)
            if is_text:
                return None
            mutant.op = COMPUTED[type(operator)]()
        case ast.BoolOp(op=ast.And()):
            mutant.op = ast.Or()
        case ast.BoolOp(op=ast.Or()):
            mutant.op = ast.And()
        case ast.UnaryOp(op=ast.USub() | ast.Not(), operand=operand):
            return operand
        case ast.Constant(value=bool() | int() | float() as value):
            mutant.value = other_number(value)
        case ast.Call():
            return changed_call(mutant)
        case _:
            return None
    return mutant


def changed_call(mutant: ast.Call) -> ast.expr | None:
    """A call without its limit or with two arguments swapped, in place; None as above."""
    match mutant:
        case ast.Call(func=called, args=[size]) if ast.unparse(called) in SIGNLESS:
            return size
        case ast.Call(func=called, args=[size, _, *_]) if ast.unparse(called) in LIMITING:
            return size
        case ast.Call(args=[ast.Name() as first, ast.Name() as second, *others]):
            mutant.args = [second, first, *others]
            return mutant
    return None


def changed_statement(mutant: ast.stmt) -> ast.stmt | None:
    """The statement with one fault, changed in place; None as above."""
    match mutant:
        case ast.AugAssign(op=operator) if type(operator) in COMPUTED:
            mutant.op = COMPUTED[type(operator)]()
            return mutant
        case ast.Expr(value=ast.Call()):
            return ast.Pass()
        case ast.If(body=[ast.Raise() | ast.Return() | ast.Continue()], orelse=[]):
            return ast.Pass()
    return None


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


def drawn(count: int, seed: int, rooms: Sequence[str]) -> list[Mutant]:
    """Mutants by chance, each of the rooms' as probable as any other."""
    mutants: list[Mutant] = []
    for room in rooms:
        place = ROOT / "hilstar" / room
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            mutants += mutants_of(path)
    print(f"{len(mutants)} mutants in all", flush=True)
    return random.Random(seed).sample(mutants, min(count, len(mutants)))


@dataclass(frozen=True, slots=True)
class LineMap:
    """What tests/support/line_map.py wrote: tests by path and line, and seconds by test and file."""

    seconds: dict[str, float]
    tests: dict[str, dict[str, list[str]]]

    def tests_of(self, mutant: Mutant) -> list[str]:
        """The tests that run a mutant's statement, fastest first; a file stands for all its tests.

        A module's constant is run by those that run a statement with its name, and what else runs
        when the module is imported by each test of the module.
        """
        by_line = self.tests.get(mutant.path, {})
        names: set[str] = set()
        for line in lines_that_need(ROOT / mutant.path, mutant.line) or map(int, by_line):
            names.update(by_line.get(str(line), []))
        fastest_first = sorted(names, key=lambda name: self.seconds.get(name, 0.0))
        chosen: list[str] = []
        total_s = 0.0
        for name in fastest_first:
            total_s += self.seconds.get(name, 0.0)
            if chosen and total_s > MAX_TESTS_OF_LINE_S:
                break
            chosen.append(name)
        return chosen


def lines_that_need(path: Path, line: int) -> set[int]:
    """The lines of the innermost statement that has a line, without those of its body, or of all
    statements of functions that name the constants that it sets; none where it is another that
    runs when the module is imported.
    """
    tree = ast.parse(path.read_bytes())
    innermost: ast.stmt | None = None
    in_functions: list[ast.stmt] = []
    for node in ast.walk(tree):  # outer ones first
        if isinstance(node, ast.stmt) and line in own_lines(node):
            innermost = node
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            for part in node.body:
                in_functions += [each for each in ast.walk(part) if isinstance(each, ast.stmt)]
    if innermost is None:
        return set()
    if innermost in in_functions:
        return set(own_lines(innermost))
    constants = {each.id for each in ast.walk(innermost) if isinstance(each, ast.Name)}
    needing: set[int] = set()
    for statement in in_functions:
        named = {each.id for each in ast.walk(statement) if isinstance(each, ast.Name)}
        if named & constants and innermost in tree.body:
            needing.update(own_lines(statement))
    return needing


def own_lines(node: ast.stmt) -> range:
    """The lines of a statement, without those of its body."""
    body = getattr(node, "body", [])
    return range(node.lineno, body[0].lineno if body else (node.end_lineno or node.lineno) + 1)


def functions_to_run(mutant: Mutant, session: Session, line_map: LineMap | None) -> list[str]:
    """The test functions of a mutant: those of its line, or without a map the near ones."""
    if line_map is None:
        return session.near(dotted_name(mutant.path))
    functions: list[str] = []
    for name in line_map.tests_of(mutant):
        if "::" in name:
            functions.append(name)
        else:
            functions += [each for each in session.items if each.startswith(f"{name}::")]
    # a map may be older than a test's name
    return [each for each in dict.fromkeys(functions) if each in session.items]


def outcome_of(
    mutant: Mutant, session: Session, line_map: LineMap | None, *, with_near: bool
) -> Outcome:
    """What the tests say of a mutant, and the time that it took."""
    begun_s = time.monotonic()
    source = (ROOT / mutant.path).read_bytes()
    changed_source = source[: mutant.start_byte] + mutant.after.encode() + source[mutant.end_byte :]
    fault = ChangedFile(mutant.path, source.decode(), changed_source.decode())
    functions = functions_to_run(mutant, session, line_map)
    test = session.test_that_finds(fault, functions)
    if not test and with_near and line_map is not None:
        near = [each for each in session.near(dotted_name(mutant.path)) if each not in functions]
        test = session.test_that_finds(fault, near)
    wall_s = time.monotonic() - begun_s
    return Outcome(mutant.path, mutant.line, mutant.before, mutant.after, test, round(wall_s, 1))


def planted_faults(file: Path) -> list[Mutant]:
    """The faults of a file; ValueError where the text before a change is not once in its file."""
    faults: list[Mutant] = []
    for fault in tomllib.loads(file.read_text(encoding="utf-8"))["fault"]:
        source = (ROOT / fault["path"]).read_bytes()
        before = fault["before"].encode()
        if source.count(before) != 1:
            raise ValueError(
                f"{fault['path']} has {source.count(before)} times {fault['before']!r}"
            )
        start_byte = source.index(before)
        line = source.count(b"\n", 0, start_byte) + 1
        end_byte = start_byte + len(before)
        change = (fault["before"], fault["after"])
        faults.append(Mutant(fault["path"], line, *change, start_byte, end_byte))
    return faults


def main() -> None:
    """Draw, change, test; say the share that is found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mutants", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--rooms", nargs="+", default=ROOMS, metavar="PATH", help="folders and files of hilstar/"
    )
    parser.add_argument(
        "--near", action="store_true", help="tests that name the module or its room"
    )
    parser.add_argument("--by-lines", type=Path, metavar="MAP", help="tests that run the line")
    parser.add_argument("--rest", action="store_true", help="what README's command leaves out")
    parser.add_argument("--planted", type=Path, metavar="FILE", help="faults that are written down")
    parser.add_argument("-o", dest="output", type=Path, required=True)
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    table = (options.output / "mutants.csv").resolve()
    line_map = None
    if options.by_lines:
        line_map = LineMap(**json.loads(options.by_lines.read_text(encoding="utf-8")))
    if options.planted:
        mutants = planted_faults(options.planted)
    else:
        mutants = drawn(options.mutants, options.seed, options.rooms)
    done = 0
    if table.exists():
        with table.open(encoding="utf-8") as rows:
            done = len(list(csv.DictReader(rows)))
    else:
        table.write_text(",".join(field.name for field in fields(Outcome)) + "\n", encoding="utf-8")

    def run_each(session: Session) -> None:
        for mutant in mutants[done:]:
            outcome = outcome_of(mutant, session, line_map, with_near=options.near)
            with table.open("a", encoding="utf-8", newline="") as rows:
                csv.writer(rows).writerow(asdict(outcome).values())
            print(outcome, flush=True)

    with_tests(run_each, is_rest=options.rest)
    with table.open(encoding="utf-8") as rows:
        tests = [row["test"] for row in csv.DictReader(rows)]
    held = sum(bool(test) for test in tests)
    print(f"{held} of {len(tests)} are found, {100 * held / len(tests):.0f} %")


if __name__ == "__main__":
    main()
