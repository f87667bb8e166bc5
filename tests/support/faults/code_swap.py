"""A fault put into a module that is imported already: its functions get the code of its changed
text, and its constants the changed values. It is for a process of one fault, which then ends.

What has run and cannot be run again, as the body of a class or a function's default, is refused:
such a fault needs a process that imports the module anew.
"""

from __future__ import annotations

import ast
import copy
import gc
import inspect
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import CodeType, FunctionType, ModuleType

# A code object by its qualified name and how many of that name stand before it: "<lambda>" is many.
Place = tuple[str, int]


class NotSwappable(Exception):
    """The module has to be imported with the change."""


def swap(module: ModuleType, text: str, changed_text: str) -> None:
    """Let a module that was imported from `text` do what `changed_text` says.

    NotSwappable where what changes has run when the module was imported, but for constants that no
    other one is made of. Functions that the garbage collector has frozen are not found.
    """
    assert module.__file__ is not None
    code = compile(text, module.__file__, "exec", dont_inherit=True)
    changed_code = compile(changed_text, module.__file__, "exec", dont_inherit=True)
    codes = dict(codes_within(code))
    changed_codes = dict(codes_within(changed_code))
    if codes.keys() != changed_codes.keys():
        raise NotSwappable("it has other functions")
    is_function_changed = False
    for place, before in codes.items():
        after = changed_codes[place]
        is_function = bool(before.co_flags & inspect.CO_OPTIMIZED)
        if not is_function and not is_same(before, after, with_inner=False):
            raise NotSwappable(f"the body of {place[0]} has run")
        is_function_changed |= is_function and not is_same(before, after, with_inner=True)
    if not is_same(code, changed_code, with_inner=False):
        set_constants(module, text, changed_text)
    if is_function_changed:
        set_codes(module.__file__, codes, changed_codes)


def codes_within(
    code: CodeType, counts: Counter[str] | None = None
) -> Iterator[tuple[Place, CodeType]]:
    """Each function and class within a code object, at every depth, by its place."""
    counts = Counter() if counts is None else counts
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield (inner.co_qualname, counts[inner.co_qualname]), inner
            counts[inner.co_qualname] += 1
            yield from codes_within(inner, counts)


def is_same(code: CodeType, other: CodeType, *, with_inner: bool) -> bool:
    """Whether two code objects do the same, wherever their lines stand; `with_inner`: and so do
    the functions and classes within them.
    """
    if _parts(code) != _parts(other) or len(code.co_consts) != len(other.co_consts):
        return False
    for constant, other_constant in zip(code.co_consts, other.co_consts, strict=True):
        if isinstance(constant, CodeType) and isinstance(other_constant, CodeType):
            if with_inner and not is_same(constant, other_constant, with_inner=True):
                return False
        # by their text, too: 0.0 equals -0.0 and False
        elif repr(constant) != repr(other_constant):
            return False
    return True


def _parts(code: CodeType) -> tuple[object, ...]:
    # what stands in `try` is not in the bytecode
    return (
        *(code.co_code, code.co_exceptiontable, code.co_flags),
        *(code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars),
    )


def set_codes(
    file: str, codes: Mapping[Place, CodeType], changed_codes: Mapping[Place, CodeType]
) -> None:
    """Give the functions of a file that live their changed codes.

    NotSwappable where none lives of a function that stands in no other one: a library holds its
    code alone.
    """
    functions: defaultdict[CodeType, list[FunctionType]] = defaultdict(list)
    for thing in gc.get_objects():
        if isinstance(thing, FunctionType) and thing.__code__.co_filename == file:
            functions[thing.__code__].append(thing)
    for place, before in codes.items():
        after = changed_codes[place]
        is_function = bool(before.co_flags & inspect.CO_OPTIMIZED)
        if not is_function or is_same(before, after, with_inner=True):
            continue
        living = functions[before]
        if not living and "<" not in place[0]:
            raise NotSwappable(f"{place[0]} is held by no function")
        for function in living:
            try:
                function.__code__ = after
            except ValueError as error:
                raise NotSwappable(f"{place[0]} has other variables around it") from error


def set_constants(module: ModuleType, text: str, changed_text: str) -> None:
    """Set a module's changed constants, in it and in the modules that have imported them."""
    statements = ast.parse(text).body
    changed_statements = ast.parse(changed_text).body
    if len(statements) != len(changed_statements):
        raise NotSwappable("it has other statements")
    names = vars(module)
    for statement, changed_statement in zip(statements, changed_statements, strict=True):
        if head(statement) == head(changed_statement):
            continue
        if not isinstance(changed_statement, (ast.Assign, ast.AnnAssign)):
            raise NotSwappable(f"its line {statement.lineno} has run")
        before = dict(names)
        part = ast.Module([changed_statement], [])
        exec(compile(part, str(module.__file__), "exec", dont_inherit=True), names)
        changed = {name for name in before if before[name] is not names[name]}
        if are_read_at_import(changed, module, statement):
            raise NotSwappable(f"what its line {statement.lineno} sets is read by import")
        for name in changed:
            for other in list(sys.modules.values()):
                if getattr(other, "__dict__", {}).get(name) is before[name]:
                    setattr(other, name, names[name])


def head(statement: ast.stmt) -> str:
    """What a statement of a module is, but for the bodies of functions and classes."""
    if not isinstance(statement, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
        return ast.dump(statement)
    without_body = copy.copy(statement)
    without_body.body = []
    return ast.dump(without_body)


def are_read_at_import(names: set[str], setting_module: ModuleType, setting: ast.stmt) -> bool:
    """Whether another statement of its module or of hilstar reads one of these names when it is
    imported: another constant, the body of a class, a default, a decorator.
    """
    hilstar = [module for name, module in sys.modules.items() if name.startswith("hilstar.")]
    for module in {setting_module, *hilstar}:
        if module.__file__ is None:
            continue
        text = Path(module.__file__).read_text(encoding="utf-8")
        if not any(name in text for name in names):
            continue
        for statement in statements_at_import(ast.parse(text)):
            is_setting = module is setting_module and statement.lineno == setting.lineno
            if not is_setting and names & names_read(statement):
                return True
    return False


def statements_at_import(tree: ast.AST) -> Iterator[ast.stmt]:
    """The statements of a module that run when it is imported."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.stmt) and not isinstance(node, (ast.Import, ast.ImportFrom)):
            yield node
        if isinstance(node, (ast.ClassDef, ast.If, ast.Try, ast.For, ast.With)):
            yield from statements_at_import(node)


def names_read(statement: ast.stmt) -> set[str]:
    """The names that a statement reads when it runs, a function's those of its defaults and
    decorators.
    """
    read: list[ast.AST] = [statement]
    if isinstance(statement, (ast.FunctionDef, ast.AsyncFunctionDef)):
        defaults = [*statement.args.defaults, *statement.args.kw_defaults]
        read = [each for each in defaults if each is not None]
        read += statement.decorator_list
    elif isinstance(statement, (ast.ClassDef, ast.If, ast.Try, ast.For, ast.With)):
        read = []  # their statements are looked at by themselves
    names: set[str] = set()
    for part in read:
        for node in ast.walk(part):
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
                names.add(node.id)
            elif isinstance(node, ast.Attribute):
                names.add(node.attr)
    return names
