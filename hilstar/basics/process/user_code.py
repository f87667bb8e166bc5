"""A user's Python functions, named as "python:MODULE:FUNCTION": where they may come from, and how
they are loaded.

A bench file comes from other people, too. One that could name any module would run a shell:
`python:os:system` does. So the module is a file beside the one that names it, which whoever took
the folder could read, or belongs to a package that the bench file trusts by name. docs/bench-pc.md
says what that means.
"""

import importlib
import sys
from collections.abc import Callable, Collection
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import Any

PREFIX = "python:"
ADVICE = (
    'put it there, or write [answers] trust = ["{package}"] if it is an installed package that you'
    " trust"
)
_folders: dict[str, str] = {}  # of the modules that were loaded here


class UserCodeError(Exception):
    """A function that cannot be had; the message says why, and what to do."""


def user_function(name: str, folder: Path, trust: Collection[str] = ()) -> Callable[..., Any]:
    """The function of a module in `folder`, or of one of the installed packages in `trust`.
    Raises UserCodeError.
    """
    module_name, _, function_name = name.removeprefix(PREFIX).partition(":")
    if not module_name or not function_name:
        raise UserCodeError("names no function")
    package = module_name.partition(".")[0]
    if package not in trust:
        _check_place(package, str(folder.resolve()))
    try:
        module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # whatever a user's module does; a script may exit
        raise UserCodeError(
            f"{module_name} cannot be imported ({type(error).__name__}: {error})"
        ) from error
    finally:
        _look_here_last(str(folder.resolve()))
    function = getattr(module, function_name, None)
    if not callable(function):
        raise UserCodeError(f"{module_name} has no function {function_name}")
    return function  # type: ignore[no-any-return]


def _check_place(package: str, folder: str) -> None:
    """Have `package` imported from `folder`, and from nowhere else."""
    importlib.invalidate_caches()
    spec = PathFinder.find_spec(package, [folder])
    if spec is None:
        raise UserCodeError(
            f"no module {package} stands in {folder}; {ADVICE.format(package=package)}"
        )
    loaded = sys.modules.get(package)
    # Python would give the package of that name again that it has loaded from another folder.
    if loaded is not None and package in _folders and _folders[package] != folder:
        for module_name in list(sys.modules):
            if module_name.partition(".")[0] == package:
                del sys.modules[module_name]
        loaded = None
    is_foreign = package in sys.stdlib_module_names or (
        loaded is not None and not _is_same(loaded.__spec__, spec)
    )
    if is_foreign:
        raise UserCodeError(
            f"{package} is the name of a module of Python or of hilstar; give {folder}/{package}"
            " another"
        )
    _folders[package] = folder
    sys.path.insert(0, folder)


def _is_same(one: ModuleSpec | None, other: ModuleSpec) -> bool:
    return one is not None and one.origin == other.origin


def _look_here_last(folder: str) -> None:
    """Put a folder last in the search path: the module there finds its neighbours, and nothing
    there hides an installed package.
    """
    while folder in sys.path:
        sys.path.remove(folder)
    sys.path.append(folder)
