"""Campaigns' plans that are refused: what is written, and the words of the one line that says so."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from hilstar.instruments.campaign.cases import CaseMaker
from hilstar.instruments.campaign.plan import read_plan
from hilstar.server.bench.bench_file import read_bench_file
from tests.support.campaigns import plan_text, write_campaign
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.refusals import refusal

PSF: dict[str, Any] = {"key": "tracker.psf_sigma_px", "minimum": 0.5, "maximum": 1.0}
SUN = (
    {"key": "sky.epoch_utc", "values": ["2026-03-20T12:00:00"]},
    {"key": "sky.bodies.sun", "values": [True]},
    {"key": "body_deg", "values": [30.0]},
)

# what is varied instead of PSF, the plan's other keys, and words
BY_THE_COMMAND = {
    "no bench": ({}, {"bench": None}, ["bench", "missing"]),
    "unknown key": ({}, {"case": 3}, ["unknown key case", "cases"]),
    "unknown sampling": ({}, {"sampling": "random"}, ["sampling", "latin-hypercube"]),
    "no cases": ({}, {"cases": None}, ["cases"]),
    "negative cases": ({}, {"cases": -1}, ["cases", "-1"]),
    "no such bench": ({}, {"bench": "other.toml"}, ["other.toml"]),
    "unknown bench key": ({"key": "tracker.psf_sigma"}, {}, ["tracker.psf_sigma", "psf_sigma_px"]),
    "beyond the bench's limits": ({"minimum": 0.01}, {}, ["tracker.psf_sigma_px", "0.01"]),
    "beyond them at the other end": ({"maximum": 1e4}, {}, ["tracker.psf_sigma_px", "10000"]),
    "no table": ({"key": "psf"}, {}, ["psf"]),
    "turned round": ({"minimum": 2.0}, {}, ["smaller one first"]),
    "half a range": ({"maximum": None}, {}, ["minimum"]),
    "neither": ({"minimum": None, "maximum": None}, {}, ["values"]),
    "both": ({"values": [1.0]}, {}, ["either"]),
    "log of 0": (
        {"key": "rate_deg_s.x", "minimum": 0, "maximum": 1, "scale": "log"},
        {},
        ["log", "above 0"],
    ),
    "grid without steps": ({}, {"sampling": "grid"}, ["steps"]),
    "rate of text": (
        {"key": "rate_deg_s.x", "minimum": None, "maximum": None, "values": ["fast"]},
        {},
        ["fast"],
    ),
    "rate of a switch": (
        {"key": "rate_deg_s.x", "minimum": None, "maximum": None, "values": [True]},
        {},
        ["the value True; write a number from"],
    ),
    "display's key, no display": (
        {"key": "monitor.refresh_hz", "minimum": 50, "maximum": 60},
        {},
        ["display"],
    ),
    "index beyond": ({"key": "tracker.psf_sigma_px.7"}, {}, ["0 to 1"]),
}


@pytest.mark.parametrize("wrong", BY_THE_COMMAND)
def test_the_command_refuses_a_plan_in_one_line_with_exit_code_2(
    tmp_path: Path, wrong: str
) -> None:
    varied, keys, words = BY_THE_COMMAND[wrong]
    plan = write_campaign(tmp_path, PSF | varied, **keys)
    assert_refused(run_hilstar_here("campaign", plan, "-o", tmp_path / "out"), 2, *words)
    assert not (tmp_path / "out").exists()


def required(*lines: str) -> str:
    """A plan with one requirement."""
    return "\n".join([plan_text() + "[[require]]", *lines]) + "\n"


def noise(*lines: str) -> str:
    return required('quantity = "noise"', *lines)


def looking(*vary: dict[str, Any], **attitudes: Any) -> str:
    """A plan that looks there."""
    return plan_text(*vary, attitudes=attitudes)


CLAUSE = ("", "[[require]]")
PLANS = [
    (looking(kind="field"), "radec_deg"),
    (looking(kind="log"), "log"),
    (looking(radec_deg=[1, 2]), "field"),
    (looking(kind="all-sky", radec_deg=[1, 2]), 'radec_deg is for kind = "field"'),
    (plan_text(SUN[2], SUN[2] | {"key": "limb_deg"}), "are one angle"),
    (looking(*SUN, kind="body", body="moon"), "bench has none"),
    (looking(*SUN, kind="body"), "go together"),
    (noise(), "either maximum or minimum"),
    (noise("maximum = 1", "minimum = 0"), "either maximum or minimum"),
    (noise("maximum = 3", 'condition = "fast"'), 'write such as "rate_deg_s.across <= 0.5"'),
    (noise("maximum = 3", "confidence = 95"), "confidence"),
    (required('quantity = "speed"', "maximum = 1"), "speed"),
    (required('quantity = "availability"', "minimum = 95"), "a share from 0 to 1"),
    (required('quantity = "availability"', "minimum = 0.9", 'axis = "x"'), "has no axis"),
    (required('quantity = "bias"', "maximum = 3", "share = 0.9"), "leave share out"),
    (required('quantity = "rate-bias"', "maximum = 1.0"), "write columns = "),
    (required('quantity = "edge"', "maximum = 1.0"), "is of a sweep"),
    (noise("maximum = 3", *CLAUSE, 'quantity = "edge"', "maximum = 1"), "number 2 .edge.: is of"),
    (noise("maximum = 3", *CLAUSE, 'quantity = "noise"'), "number 2 .noise.: "),
]


JITTER = {"key": "jitter_arcsec.across", "values": [10.0]}
HZ = {"key": "jitter_hz", "values": [10.0]}
SLEW = {"key": "motion_s", "values": [2.0]}
PLANS += [
    (plan_text(answers=2), 'answers: is for through = "bench"; write that, or leave answers out'),
    (plan_text(through="bench", frames=2), 'frames: is for through = "tracker" or "display";'),
    (plan_text(JITTER), "go together"),
    (plan_text(HZ), "go together"),
    (
        plan_text(JITTER, HZ | {"values": [1e4]}),
        "too fast for an exposure of 0.1 s; .* at most 250",
    ),
    (plan_text(JITTER, HZ | {"values": [-1.0]}), "a number from 0 to"),
    (plan_text(JITTER, HZ, through="display"), "within an exposure"),
    (plan_text(SLEW, through="display"), "within an exposure"),
    (plan_text(JITTER, HZ | {"values": [20.0]}, through="bench"), "20 Hz on a display of 60 Hz"),
    (plan_text(SLEW, {"key": "scenario", "values": [""]}), "leave one of them out"),
    (plan_text(SLEW, columns=["rate"]), "errors of the rate are not told"),
    (plan_text(JITTER, HZ, columns=["rate"]), "errors of the rate are not told"),
    (looking(*SUN, kind="body", body="venus"), "sky.bodies.planets"),
    (looking(*SUN, kind="body", body="pluto"), "pluto"),
    (plan_text(SLEW, SLEW), 'key = "motion_s" stands there twice'),
    (plan_text(PSF, SLEW, PSF), 'key = "tracker.psf_sigma_px" stands there twice'),
    (noise("maximum = 3", """condition = 'why < "clouds"'"""), "such as"),
    (noise("maximum = 3", """condition = 'why == clouds'"""), "such as"),
    (plan_text() + '[centroids]\ncentroider = "psf"\npsf_focus_um = 5.0\n', 'psf is "tracker"'),
    (
        plan_text() + '[centroids]\ncentroider = "psf"\npsf = "gaussian"\npsf_focus_um = -5.0\n',
        'psf is "gaussian"; leave it out',
    ),
    (plan_text() + "[centroids]\npsf_focus_um = 5.0\n", 'are for centroider = "psf"'),
]

ENDLESS = {"minimum": None, "maximum": None, "values": [0.7]}
LOG: dict[str, Any] = {"kind": "log", "log": "log.csv"}
ACCELERATION = {"key": "acceleration_deg_s2.x", "values": [1.0]}
PLANS += [
    (looking(log="log.csv"), 'log is for kind = "log", and kind is "all-sky"; write that'),
    (plan_text(PSF | ENDLESS | {"steps": 3}), "steps and scale are for minimum and maximum; leave"),
    (plan_text(PSF | ENDLESS | {"scale": "log"}), "steps and scale are for minimum and maximum;"),
    (plan_text(PSF | {"steps": 3}), 'steps is for sampling = "grid"; leave it out'),
    (plan_text({"key": "scenario", "values": [3]}), "the value 3; write paths of scenario files"),
    (plan_text({"key": "scenario", "minimum": 0, "maximum": 1}), "the value 0.0; write paths of"),
    (plan_text({"key": "scenario", "values": []}), "array. of length >= 1"),
    (looking({"key": "time_s", "values": [1.0]}, **LOG), "the times are the log's; leave it out"),
    (looking(ACCELERATION, **LOG), "the motion is the log's; leave it out"),
]


def cases_of(plan: Path) -> CaseMaker:
    """The cases of a plan over its bench."""
    return CaseMaker(read_plan(plan), read_bench_file(plan.parent / "bench.toml"), plan.parent)


@pytest.mark.parametrize(("text", "words"), PLANS)
def test_what_is_no_plan_is_refused_in_one_line(tmp_path: Path, text: str, words: str) -> None:
    plan = write_campaign(tmp_path)
    plan.write_text(text)
    (tmp_path / "log.csv").write_text("t_s,qw,qx,qy,qz\n0,1,0,0,0\n9,1,0,0,0\n")
    line = refusal(cases_of, plan)
    assert re.search(words, line), line
