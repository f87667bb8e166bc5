"""The errors of Hipparcos' magnitudes by where they are from."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.sky.catalog import plain_catalog
from hilstar.sky.facts import errors_of, facts_of, sigma_v_mag


# The scatter of V about what was measured: from the catalogue's introduction by source and colour.
@pytest.mark.parametrize(
    ("source", "bv_mag", "scatter_mag"),
    [
        (b"G", 0.99, 0.010),
        (b"G", 1.0, 0.025),
        (b"T", 0.5, 0.010),
        (b"T", 1.5, 0.025),
        (b"H", 0.5, 0.004),
        (b"H", 1.5, 0.004),
        (b"U", 1.5, 0.0),
        (b"", 0.5, np.nan),
    ],
)
def test_the_error_of_v_is_that_of_what_was_measured_and_its_scatter(source, bv_mag, scatter_mag):
    facts = {"v_source": np.array([source]), "sigma_measured_mag": np.array([0.003])}
    found = sigma_v_mag(facts, np.array([bv_mag]))
    assert found[0] == pytest.approx(np.hypot(0.003, scatter_mag), nan_ok=True)


def test_a_number_that_hipparcos_lacks_has_no_facts():
    """HIP 1 is there, 0 is none and 999 999 is beyond the last."""
    facts = facts_of(np.array([1, 0, 999_999], dtype=np.int32))
    known = np.isfinite(facts["sigma_measured_mag"])
    assert known.tolist() == [True, False, False]


@pytest.mark.parametrize(
    ("identifier", "epoch_jyear", "is_known"),
    [(1, 1991.25, True), (1, 2016.0, False), (7, 1991.25, False)],
)
def test_only_figures_of_hipparcos_itself_have_its_errors(identifier, epoch_jyear, is_known):
    """A table's first row may be HIP 1, whose place it has of another epoch."""
    columns = {
        "hip": np.array([1], dtype=np.int32),
        "identifier": np.array([identifier]),
        "epoch_jyear": np.array([epoch_jyear]),
        **{name: np.zeros(1) for name in ("v_mag", "ra_deg", "dec_deg")},
    }
    errors = errors_of(plain_catalog("HIP", 1, columns))
    sigmas = [errors[name][0] for name in errors if name.startswith("sigma_")]
    assert len(sigmas) == 8 and np.isfinite(sigmas).tolist() == [is_known] * 8
