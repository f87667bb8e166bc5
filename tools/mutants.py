"""What README's test command holds: faults drawn by chance, one at a time, and which of them it
finds.

    python tools/mutants.py --mutants 60 --seed 1 -o DIR
    python tools/mutants.py --mutants 40 --near -o DIR
    HILSTAR_LINE_MAP=MAP pytest -n0 -p tests.support.line_map
    python tools/mutants.py --mutants 140 --seed 2 --by-lines MAP --near -o DIR
    python tools/mutants.py --mutants 40 --rooms attitude/logs server/loop.py -o DIR
    python tools/mutants.py --planted tools/planted_faults.toml --by-lines MAP --near -o DIR

Each mutant is one change in a core room, or in those of --rooms, in a copy of the checkout: one
expression, one call, check or limit that is left out, or two arguments that are swapped. DIR gets
mutants.csv: the change, and the test that fails ("" where none does). A test counts that fails
twice with the change and passes without it: what fails by the machine's load, or for what the copy
lacks, is said and passed over. A run that is stopped goes on where it was. With --near only those
of README's tests run whose files name the changed module or its room: a few seconds a mutant. With
--by-lines those run that run the changed line, fastest first, and near ones (with --near) where
none of them fails: tests in processes of their own are not in the map. --planted takes its changes
from a file of faults that were thought of, and --rest the tests that README's command leaves out.
Some mutants are no fault (a limit of memory that is one byte larger): the share that is found is a
lower bound.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import copy
import csv
import gc
import importlib
import itertools
import json
import multiprocessing
import os
import random
import re
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path

# One process a core is enough, and threads would not survive a fork. Before NumPy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest

sys.dont_write_bytecode = False  # else each run compiles what it imports

ROOT = Path(__file__).parent.parent
ROOMS = ("sky", "optics", "display", "attitude", "tracker", "server/loop.py")
# A mutant that never ends is found, too: an unchanged checkout takes a tenth of it when idle.
MAX_RUN_S = 1800
# The tests of a line that are run: few faults that the fastest pass are found by slower ones.
MAX_TESTS_OF_LINE_S = 30.0
HANGS = "it does not end"
# a test that takes longer waits for what never comes, and ends the run (pytest 9.0 or newer)
STUCK_S = 60
# tests of one mutant that fail for other reasons, before its outcome is "none found"
MAX_PASSED_OVER = 5
STUCK_ENDS = (
    *("-o", f"faulthandler_timeout={STUCK_S}"),
    *("-o", "faulthandler_exit_on_timeout=true"),
)
FAILED = re.compile(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", re.MULTILINE)
NOTHING_TO_RUN = 5  # pytest's exit code
# the environment variables of tests/support/near_first.py
NEAR, NEAR_ALONE = "HILSTAR_NEAR", "HILSTAR_NEAR_ALONE"

# imported once for all runs
LIBRARIES = (
    *("astropy.coordinates", "astropy.table", "astropy.time", "astropy.wcs", "hypothesis"),
    *("matplotlib.figure", "mcap.reader", "moderngl", "msgspec", "numpy.ma", "PIL.Image"),
    *("rich.console", "scipy.integrate", "scipy.interpolate", "scipy.ndimage", "scipy.optimize"),
    *("scipy.signal", "scipy.sparse.linalg", "scipy.spatial", "scipy.special", "scipy.stats"),
    *("hypothesis.internal.observability", "skyfield.api", "typer", "xdist.plugin", "zmq"),
)
ALREADY_IMPORTED = ("-W", "ignore::pytest.PytestAssertRewriteWarning")
FORK = multiprocessing.get_context("fork")
CHANGES = itertools.count(1)
# the first test that fails, but for those that are named
First = Callable[[Sequence[str]], str]

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


def copy_checkout(folder: Path) -> None:
    """The tracked files, in `folder`."""
    archive = subprocess.run(
        ["git", "archive", "--format=tar", "HEAD"], cwd=ROOT, check=True, capture_output=True
    )
    subprocess.run(["tar", "-x", "-C", folder], input=archive.stdout, check=True)


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


@dataclass(frozen=True, slots=True)
class Suite:
    """README's tests in a copy of the checkout, nearest to a module first; `is_near`: the near
    ones alone; `is_rest`: those that README's command leaves out.
    """

    checkout: Path
    is_near: bool
    is_rest: bool

    def first_of(self, tests: Sequence[str], passed_over: Sequence[str] = ()) -> str:
        """As `first_failure`, of the tests that are named, in their order."""
        chosen = [test for test in tests if test not in passed_over]
        if not chosen:
            return ""
        names = self.checkout / "chosen_tests.txt"
        names.write_text("\n".join(chosen), encoding="utf-8")
        return self._pytest(["-x", *deselected(passed_over), f"@{names}"], {})

    def first_failure(self, module: str, passed_over: Sequence[str] = ()) -> str:
        """The first test that fails but for those `passed_over`, "" where none does.

        One that does not end is one that fails. HANGS where the tests together take too long;
        pytest's last line where no test is named.
        """
        arguments = ["-x", "-p", "tests.support.near_first", *deselected(passed_over)]
        if self.is_rest:
            arguments.append("--rest")
        variables = {NEAR: module}
        if self.is_near:
            variables[NEAR_ALONE] = "1"
        return self._pytest(arguments, variables)

    def fails(self, test: str) -> bool:
        """Whether a test fails by itself."""
        return bool(self._pytest([test], {}))

    def _pytest(self, arguments: list[str], variables: dict[str, str]) -> str:
        with tempfile.TemporaryFile() as output:
            options = ["-v", "-n0", *ALREADY_IMPORTED, *STUCK_ENDS, *arguments]
            run = FORK.Process(target=self._run, args=(options, variables, output.fileno()))
            run.start()
            run.join(MAX_RUN_S)
            if run.exitcode is None:
                run.kill()
                run.join()
                return HANGS
            output.seek(0)
            text = output.read().decode(errors="replace")
        if run.exitcode in (0, NOTHING_TO_RUN):
            return ""
        failed = FAILED.search(text)
        if failed is not None:
            return failed[1]
        # of a run that a stuck test ended, the name of that test
        return (text or "no output").strip().splitlines()[-1].strip()

    def _run(self, options: list[str], variables: dict[str, str], output: int) -> None:
        """pytest in a process of its own, which begins with the libraries that are imported here:
        that takes a third of a new one's time.
        """
        os.dup2(output, 1)
        os.dup2(output, 2)
        os.chdir(self.checkout)
        os.environ |= {"PYTHONPATH": str(self.checkout)} | variables
        sys.path[0] = str(self.checkout)
        sys.exit(pytest.main(options))


def deselected(tests: Sequence[str]) -> list[str]:
    """pytest's options that leave tests out."""
    options: list[str] = []
    for test in tests:
        options += ["--deselect", test]
    return options


@contextlib.contextmanager
def planted(mutant: Mutant, checkout: Path) -> Iterator[None]:
    """The mutant in the copy, and afterwards the file as it was."""
    path = checkout / mutant.path
    source = path.read_bytes()
    source_ns = path.stat().st_mtime_ns
    path.write_bytes(
        source[: mutant.start_byte] + mutant.after.encode() + source[mutant.end_byte :]
    )
    # compiled modules are known by their source's size and time to the second
    changed_ns = source_ns + next(CHANGES) * 1_000_000_000
    os.utime(path, ns=(changed_ns, changed_ns))
    try:
        yield
    finally:
        path.write_bytes(source)
        os.utime(path, ns=(source_ns, source_ns))


def test_that_finds(
    mutant: Mutant, checkout: Path, fails: Callable[[str], bool], first: First
) -> str:
    """The first test that fails by a mutant, "" where none does; `first` names a test that fails
    but for those passed over, `fails` runs one by itself.
    """
    passed_over: list[str] = []
    while len(passed_over) < MAX_PASSED_OVER:
        with planted(mutant, checkout):
            test = first(passed_over)
            if not test:
                return ""
            is_named = test.startswith("tests/")
            fails_again = not is_named or fails(test)
        if is_named:
            fails_unchanged = fails(test)
        else:
            fails_unchanged = first(passed_over) == test
        if fails_again and not fails_unchanged:
            return test
        why = "fails without it, too" if fails_unchanged else "passes when it is run again"
        print(f"{mutant.path}:{mutant.line}: {test} does not count: it {why}", flush=True)
        if not is_named:
            return ""
        passed_over.append(test)
    return ""


def outcome_of(mutant: Mutant, suite: Suite, line_map: LineMap | None) -> Outcome:
    """What the tests say of a mutant, and the time that it took."""
    begun_s = time.monotonic()
    module = mutant.path.removesuffix(".py").replace("/", ".")
    test = ""
    if line_map is not None:
        tests = line_map.tests_of(mutant)
        test = test_that_finds(mutant, suite.checkout, suite.fails, partial(suite.first_of, tests))
    if not test and (line_map is None or suite.is_near):
        first = partial(suite.first_failure, module)
        test = test_that_finds(mutant, suite.checkout, suite.fails, first)
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
    table = options.output / "mutants.csv"
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
    for name in LIBRARIES:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    gc.freeze()
    with tempfile.TemporaryDirectory() as temporary:
        checkout = Path(temporary)
        copy_checkout(checkout)
        suite = Suite(checkout, options.near, options.rest)
        for mutant in mutants[done:]:
            outcome = outcome_of(mutant, suite, line_map)
            with table.open("a", encoding="utf-8", newline="") as rows:
                csv.writer(rows).writerow(asdict(outcome).values())
            print(outcome, flush=True)
    with table.open(encoding="utf-8") as rows:
        tests = [row["test"] for row in csv.DictReader(rows)]
    held = sum(bool(test) for test in tests)
    print(f"{held} of {len(tests)} are found, {100 * held / len(tests):.0f} %")


if __name__ == "__main__":
    main()
