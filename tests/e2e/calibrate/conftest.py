"""What sessions of first light share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from hilstar.server import doctor


@pytest.fixture(scope="package", autouse=True)
def without_cameras() -> Iterator[None]:
    """No session here has a GenICam camera, and looking for one takes a second each: tests/screen
    does.
    """
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(doctor, "child_command", lambda: None)
        yield
