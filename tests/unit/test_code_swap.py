"""A fault that is put into an imported module does what the module does that is imported with it."""

import importlib.util
import itertools
from pathlib import Path
from types import ModuleType

import pytest

from tests.support.faults.code_swap import NotSwappable, swap

TEXT = """
from functools import cache

LIMIT_PX = 3
TWICE_PX = 2 * LIMIT_PX
STEP_PX = 5

class Detector:
    bits = 8

    def codes(self):
        return 2**self.bits - 1

def is_beyond(x_px):
    return x_px > STEP_PX

@cache
def squares(count):
    return [each**2 for each in range(count)]

def scaled(factor):
    return lambda value: factor * value

def clipped(value, highest=10):
    try:
        return min(value, highest)
    except TypeError:
        return None
"""
NAMES = (f"swapped_{number}" for number in itertools.count())


def module_of(folder: Path, text: str) -> ModuleType:
    """A module of this text, imported."""
    name = next(NAMES)
    path = folder / f"{name}.py"
    path.write_text(text)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def outcomes(module: ModuleType) -> tuple[object, ...]:
    """What each part of the module gives."""
    edge = (module.is_beyond(5), module.is_beyond(6), module.is_beyond(7))
    clipped = (module.clipped(11), module.clipped("1"))
    return edge, module.Detector().codes(), module.squares(4), module.scaled(3)(2), clipped


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("x_px > STEP_PX", "x_px >= STEP_PX"),
        ("STEP_PX = 5", "STEP_PX = 6"),
        ("2**self.bits - 1", "2**self.bits"),
        ("each**2 for", "each**3 for"),
        ("factor * value", "factor / value"),
        ("except TypeError", "except KeyError"),
        ("        return min(value, highest)\n", "        pass\n"),
    ],
)
def test_a_swapped_fault_does_what_an_imported_one_does(tmp_path, before, after):
    assert TEXT.count(before) == 1
    changed_text = TEXT.replace(before, after)
    swapped = module_of(tmp_path, TEXT)
    swap(swapped, TEXT, changed_text)
    results = []
    for module in (swapped, module_of(tmp_path, changed_text), module_of(tmp_path, TEXT)):
        try:
            results.append(outcomes(module))
        except TypeError:
            results.append("refused")
    assert results[0] == results[1] != results[2]


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("LIMIT_PX = 3", "LIMIT_PX = 4"),
        ("bits = 8", "bits = 9"),
        ("highest=10", "highest=11"),
        ("@cache\n", "@staticmethod\n"),
        ("def scaled", "def scaling"),
        ("from functools import cache", "from functools import lru_cache as cache"),
    ],
)
def test_what_has_run_at_import_is_not_swapped(tmp_path, before, after):
    assert TEXT.count(before) == 1
    module = module_of(tmp_path, TEXT)
    with pytest.raises(NotSwappable):
        swap(module, TEXT, TEXT.replace(before, after))
