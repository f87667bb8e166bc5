"""A certificate of a few figures that all differ, which nothing was read for."""

from __future__ import annotations

from typing import Any

from hilstar.server.bench.certificate_file import (
    KIND,
    ByTrials,
    Certificate,
    CertifiedFigure,
    Contribution,
    InputRow,
)

BY_CLOCK = "the largest input has few degrees of freedom"


def contribution(name: str, standard_uncertainty: float) -> Contribution:
    """An input's contribution, whose share nothing here goes by."""
    return Contribution(input=name, standard_uncertainty=standard_uncertainty, share=0.5)


def a_figure(
    quantity: str, value: float, half_width: float, unit: str, **keys: Any
) -> CertifiedFigure:
    """A figure whose interval is 3/8 of its width above the value, and 5/8 below."""
    defaults: dict[str, Any] = {
        "region": "screen",
        "star": None,
        "field": None,
        "standard_uncertainty": half_width / 2,
        "k": 2.0,
        "dof": None,
        "limit": None,
        "conforms": None,
        "truth": None,
        "by_trials": None,
        "contributions": [],
    }
    ends = {"lower": value - 1.25 * half_width, "upper": value + 0.75 * half_width}
    return CertifiedFigure(quantity=quantity, value=value, unit=unit, **ends, **(defaults | keys))


def some_figures() -> list[CertifiedFigure]:
    """Two stars' light on the left and one in the middle, a place, an attitude and a delay."""
    response = contribution("response", 0.003)
    left = {"region": "left third", "field": 0, "limit": 0.05}
    differs = ByTrials(standard_uncertainty=0.012, lower=-0.03, upper=0.055, differs=BY_CLOCK)
    alike = ByTrials(standard_uncertainty=0.0475, lower=-0.13, upper=0.06, differs="")
    return [
        a_figure(
            "flux",
            0.01,
            0.02,
            "mag",
            star=11,
            conforms=True,
            by_trials=differs,
            contributions=[response, contribution("evenness", 0.004)],
            **left,
        ),
        a_figure(
            "flux",
            -0.04,
            0.1,
            "mag",
            star=22,
            conforms=False,
            by_trials=alike,
            contributions=[response, contribution("evenness", 0.012)],
            **left,
        ),
        a_figure("flux", 0.02, 0.04, "mag", region="middle third", star=33, field=0),
        a_figure(
            "place_along",
            1.5,
            0.8,
            "arcsec",
            region="right third",
            star=33,
            field=0,
            limit=3.0,
            conforms=True,
            contributions=[contribution("geometry", 0.4)],
        ),
        a_figure("attitude_x", -2.5, 1.6, "arcsec", region="field 0", field=0),
        a_figure("attitude_y", 0.5, 1.2, "arcsec", region="field 0", field=0),
        a_figure("attitude_z", 7.0, 4.0, "arcsec", region="field 0", field=0),
        a_figure("latency", 8.25, 0.4, "ms"),
        a_figure("star_flux", 0.03, 0.08, "mag", region="left third", star=11, field=0),
    ]


def a_certificate(**keys: Any) -> Certificate:
    """The certificate of these figures: four stand at their limits or have none."""
    facts: dict[str, Any] = {
        "kind": KIND,
        "number": "H20261126-0a1b2c3d",
        "made": "2026-11-26T10:00:00+00:00",
        "valid_until": "2027-11-26",
        "hilstar": "0.0",
        "bench": "bench.toml",
        "bench_sha256": "5" * 64,
        "files": {"bench.toml": "5" * 64},
        "monitor": {"refresh_hz": 60.0},
        "collimator": {"focal_length_mm": 350},
        "read_by": "a test",
        "who": "N. N.",
        "where": "",
        "ambient": "21 C",
        "traceability": "",
        "instrument": {"name": "meter 9", "date": "2026-01-02", "relative_expanded": 0.024, "k": 2},
        "decision": "guard-band",
        "conforms": False,
        "trials": 12345,
        "two_digits_stand": False,
        "inputs": [
            InputRow(
                name="response",
                distribution="Student t",
                standard_uncertainty=0.00312,
                unit="relative",
                dof=17.6,
                source="patches of light",
            ),
            InputRow(
                name="delay",
                distribution="normal",
                standard_uncertainty=0.2,
                unit="ms",
                dof=None,
                source="stated",
            ),
        ],
        "figures": some_figures(),
        "not_assessed": ["stray light", "motion"],
        "measurands": {"flux": "light over what it should be"},
    }
    return Certificate(**(facts | keys))
