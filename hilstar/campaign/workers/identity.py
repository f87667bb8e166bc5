"""What a worker has to share with the campaign, so that its rows are the same ones, bit for bit."""

from __future__ import annotations

import functools
import hashlib
from pathlib import Path

import msgspec
import numpy as np
import scipy

import hilstar
from hilstar.resources import resource_path


class Identity(msgspec.Struct, frozen=True):
    """By what rows could differ: the program, what it computes with, and what draws."""

    hilstar: str
    code_sha256: str
    numpy: str
    scipy: str
    gl_renderer: str


WORDS = {
    "hilstar": "hilstar {0}, and the campaign is of {1}; install that version there",
    "code_sha256": "hilstar's code {0:.12} under the same version, and the campaign is of {1:.12}; install the same there",
    "numpy": "NumPy {0}, and the campaign is of {1}; install that version there",
    "scipy": "SciPy {0}, and the campaign is of {1}; install that version there",
    "gl_renderer": "the renderer {0}, and the campaign is of {1}: frames differ in their last bits; use machines of one kind",
}


@functools.cache
def code_sha256() -> str:
    """The digest of hilstar's code: its Python files and its shaders."""
    digest = hashlib.sha256()
    package, shaders = Path(hilstar.__file__).parent, resource_path("shaders", "star.vert").parent
    for root, pattern in ((package, "*.py"), (shaders, "*")):
        for path in sorted(root.rglob(pattern)):
            if path.is_file():
                digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def own_identity(gl_renderer: str) -> Identity:
    """This process's identity, with the name of the renderer that draws here."""
    return Identity(hilstar.__version__, code_sha256(), np.__version__, scipy.__version__, gl_renderer)


def difference(found: Identity, wanted: Identity) -> str | None:
    """What a worker has that the campaign has not, in words; None where they are the same."""
    for name, words in WORDS.items():
        if getattr(found, name) != getattr(wanted, name):
            return "has " + words.format(getattr(found, name), getattr(wanted, name))
    return None
