"""One browser for all tests of a file's worker: it takes a second to begin."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.support.browser import Browser, browser


@pytest.fixture(scope="session")
def chromium() -> Iterator[Browser]:
    """Debian's chromium."""
    with browser() as found:
        yield found


@pytest.fixture
def page(chromium) -> Iterator[Browser]:
    """The browser, on a laptop in the dark, whose console must have said nothing when the test
    ends.
    """
    chromium.get("about:blank")
    chromium.complaints()
    chromium.size(1366, 768)
    chromium.prefer(color_scheme="dark", reduced_motion="no-preference")
    yield chromium
    assert chromium.complaints() == []
