"""The values that Tab offers, where they come of the product's own tables."""

from __future__ import annotations

from hilstar.basics.resources import resource_path
from hilstar.cli.completion import centroiders, offered, sensor_names, stars
from hilstar.cli.pointing import parse_star
from hilstar.tracker.sensors import sensor_named
from tests.support.commands import run_hilstar_here


def test_tab_offers_what_begins_as_the_word_does():
    assert offered(("realtime", "max", "maximum"))("max") == ["max", "maximum"]
    assert offered(lambda: ("realtime", "max"))("m") == ["max"]


def test_every_star_that_tab_offers_is_one_word_that_points():
    names = offered(stars)("")
    assert {"Vega", "Sirius", "Polaris"} <= set(names)
    assert not any(" " in name for name in names)
    for name in names[:: len(names) // 7]:
        parse_star(name, 2026.0)
    assert offered(stars)("Veg") == ["Vega"]


def test_every_sensor_and_centroider_that_tab_offers_is_one_that_is_taken():
    names = offered(sensor_names)("")
    assert "imx250" in names
    assert all(sensor_named(name, "--sensor").name for name in names)
    demo = resource_path("configs", "demo.toml")
    refused = run_hilstar_here("budget", demo, "--centroider", "?")
    assert refused.stderr.endswith(f"write one of {', '.join(centroiders())}\n")
    assert offered(centroiders)("al") == ["all"]
