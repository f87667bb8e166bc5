"""Where the files that are not Python live, installed or editable."""

from pathlib import Path

from hilstar.basics.errors import InputError

PACKAGE_DIR = Path(__file__).resolve().parents[1]


def resource_path(folder: str, name: str) -> Path:
    """Path of `name` in `folder` ("shaders" or "configs").

    A wheel carries both folders inside the package; a checkout keeps them beside it.
    Raises InputError when the file is in neither place.
    """
    for root in (PACKAGE_DIR, PACKAGE_DIR.parent):
        path = root / folder / name
        if path.is_file():
            return path
    raise InputError(f"{folder}/{name}: hilstar ships no such file; reinstall hilstar")
