"""Scenario files: what is read, and how a wrong one is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from hilstar.optics.layers.fault_kinds import KINDS, fault_of, table_of
from hilstar.server.bench.scenario import parse_scenario, read_scenario
from tests.support.benches import ROOT
from tests.support.refusals import refusal

FILE = Path("faults.toml")
STAR = {"kind": "false-star", "name": "ghost", "radec_deg": [10, 20], "electrons": 5e4}

EACH_KIND = [
    STAR,
    {
        "kind": "false-star",
        "name": "moving",
        "tracker_px": [10, 20],
        "rate_px_s": [3, -4],
        "v_mag": 2.5,
    },
    {"kind": "star-gone", "name": "dark", "hip": 24436, "at_s": 1.5, "for_s": 2},
    {"kind": "flash", "name": "flare", "star": "Jupiter", "electrons_per_s": 1e6, "for_s": 0.1},
    {"kind": "cosmic-rays", "name": "burst", "number": 20, "electrons": 3000, "length_px": 15},
    {"kind": "gradient", "name": "dawn", "electrons": 200, "towards_deg": 90},
    {
        "kind": "glow",
        "name": "sun",
        "icrs": [0, 0, 1],
        "electrons_per_s": 1e4,
        "scale_deg": 3,
        "exponent": 3,
    },
    {"kind": "light-map", "name": "measured", "file": "stray.fits", "frame": "screen"},
    {"kind": "blank", "name": "cover"},
    {"kind": "freeze", "name": "stuck", "for_s": 0.5},
    {"kind": "drop", "name": "loss", "share": 0.25},
    {"kind": "attitude-step", "name": "step", "turn_arcsec": [0, 60, 0]},
]


@pytest.mark.parametrize("table", EACH_KIND, ids=lambda table: table["name"])
def test_a_fault_is_what_its_table_says_and_goes_back_into_it(table):
    fault = fault_of(table)
    assert (fault.KIND, fault.name) == (table["kind"], table["name"])
    assert fault_of(table_of(fault)) == fault


def test_the_example_scenario_has_every_kind_but_a_map():
    scenario = read_scenario(ROOT / "examples" / "faults.toml")
    assert {fault.KIND for fault in scenario.faults} == set(KINDS) - {"light-map"}


def test_the_examples_are_of_every_kind():
    assert {table["kind"] for table in EACH_KIND} == set(KINDS)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"kind": "ghost"}, "kind = 'ghost'; write one of false-star, star-gone"),
        ({"kind": None}, "the key kind is missing"),
        ({"name": None}, "the key name is missing"),
        ({"name": "a\nb"}, "write a name of printable letters"),
        ({"hight": 3}, "unknown key hight; known are"),
        ({"radec_degs": [1, 2]}, "did you mean radec_deg?"),
        ({"radec_deg": [10, 99]}, "radec_deg = [10,99]; number <= 90.0 is wanted"),
        ({"radec_deg": None}, "lacks one of radec_deg, icrs, tracker_px, screen_px"),
        ({"icrs": [0, 0, 1]}, "has radec_deg and icrs; write one of them"),
        ({"radec_deg": None, "icrs": [0, 0, 0.5]}, "its norm is 0.5; write a unit vector"),
        ({"rate_px_s": [1, 0]}, "rate_px_s moves a tracker_px or a screen_px"),
        ({"electrons": None}, "lacks one of electrons_per_s, electrons, v_mag"),
        ({"electrons": float("nan")}, "electrons = nan; a finite number is wanted"),
        ({"electrons": -1}, "electrons = -1; number > 0.0 is wanted"),
        ({"for_s": 0}, "for_s = 0; number > 0.0 is wanted"),
        ({"at_s": "soon"}, 'at_s = "soon"; number is wanted'),
    ],
)
def test_a_wrong_fault_is_refused_with_its_key_and_what_to_write(change, said):
    table = {key: value for key, value in (STAR | change).items() if value is not None}
    assert said in refusal(fault_of, table)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("seed = 1", "has no fault; write [[fault]] tables"),
        ("seed = -1", "seed = -1; whole number >= 0 is wanted"),
        ('[fault]\nkind = "blank"', "[fault] is one table; write [[fault]]"),
        ("fault = [1]", "[[fault]] 1: 1 is no table"),
        ("stars = 3", "unknown key stars; known are seed, fault"),
        (
            '[[fault]]\nkind = "blank"\nname = "a"\n[[fault]]\nkind = "drop"\nname = "a"',
            '[[fault]] 2 (a): another fault has name = "a"',
        ),
        ("[[fault]", "not TOML"),
        (
            "\n".join(
                f'[[fault]]\nkind = "gradient"\nname = "{k}"\nelectrons = 1' for k in range(17)
            ),
            "17 gradients and maps",
        ),
        (
            "\n".join(f'[[fault]]\nkind = "blank"\nname = "{k}"' for k in range(257)),
            "has 257 faults; write at most 256",
        ),
        (
            (
                '[[fault]]\nkind = "cosmic-rays"\nname = "b"\nnumber = 5000\nelectrons ='
                " 1\nlength_px = 500"
            ),
            "write at most 20000 px together",
        ),
        (
            (
                '[[fault]]\nkind = "cosmic-rays"\nname = "b"\nnumber = 3\nelectrons ='
                " 1\nlength_px = 6666.7"
            ),
            "are 20001 px of tracks; write at most 20000 px together",
        ),
        ('[[fault]]\nkind = "flash"\nname = "f"\nhip = 1\nelectrons = 1', "write for_s = 0.1"),
        (
            '[[fault]]\nkind = "attitude-step"\nname = "s"\nturn_deg = [0, 200, 0]',
            "write a turn of 180 deg at most",
        ),
    ],
)
def test_a_wrong_scenario_is_refused_with_its_file_and_table(text, said):
    line = refusal(parse_scenario, FILE, text)
    assert line.startswith("faults.toml: ")
    assert said in line


@pytest.mark.parametrize("keys", EACH_KIND, ids=lambda keys: keys["name"])
def test_a_fault_is_a_value(keys):
    """Views of faults are kept by them: equal ones have one hash, and none can be changed."""
    fault = fault_of(keys)
    assert hash(fault) == hash(fault_of(keys))
    with pytest.raises(AttributeError):
        fault.name = "another"
