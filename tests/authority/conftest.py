"""What tests beside Astropy share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest


@pytest.fixture(scope="module")
def iers_of_package() -> Iterator[None]:
    """Astropy with the table of its package: nothing is downloaded."""
    from astropy.utils import iers

    table = iers.IERS_A.read(iers.IERS_A_FILE)
    with iers.conf.set_temp("auto_download", False), iers.earth_orientation_table.set(table):
        yield
