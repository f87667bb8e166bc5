"""Former names of options: they work, and no help shows them."""

from __future__ import annotations

import json

import pytest

from hilstar.basics.resources import resource_path
from hilstar.cli.app import built
from hilstar.cli.old_names import OLD_NAMES, with_present_names
from tests.support.benches import ROOT
from tests.support.commands import assert_refused, run_hilstar_here

DEMO = resource_path("configs", "demo.toml")
LOG = str(ROOT / "examples" / "slew.csv")
ENDPOINT = "tcp://127.0.0.1:5570"
COUNTED = ("serve", "first-light")  # a former --frames meant a count, too
PAIRS = [(command, old) for command, names in OLD_NAMES.items() for old in names]


def options_of(command):
    """The names of a command's options."""
    found = built(None)
    for word in command.split():
        found = found.commands[word]
    return [name for parameter in found.params for name in parameter.opts]


@pytest.mark.parametrize(("command", "old"), PAIRS)
@pytest.mark.parametrize("value", ["3", ENDPOINT])
def test_a_former_name_is_read_as_an_option_that_the_command_has(command, old, value):
    typed = [*command.split(), "bench.toml", old, value]
    present = with_present_names(typed)
    assert present[-1] == value
    assert present[-2] in options_of(command)
    joined = with_present_names([*typed[:-2], f"{old}={value}"])
    assert joined[-1] == f"{present[-2]}={value}"


@pytest.mark.parametrize(("command", "old"), PAIRS)
def test_no_help_shows_a_former_name(command, old):
    if command != "serve":  # its --frames is a number, as before
        assert old not in options_of(command)


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--frames", "N"),
        ("--rate", "HZ"),
        ("--at", "SECONDS"),
        ("--to", "TARGET"),
        ("--duration", "SECONDS"),
        ("--wait", "SECONDS"),
        ("--feed", "ENDPOINT"),
    ],
)
def test_an_option_has_one_meaning_in_all_commands(option, value):
    values = []
    for name, command in built(None).commands.items():
        for inner in getattr(command, "commands", {name: command}).values():
            values += [p.metavar for p in inner.params if option in p.opts]
    assert values
    assert set(values) == {value}


@pytest.mark.parametrize("command", COUNTED)
def test_frames_with_an_endpoint_feed_who_watches(command):
    typed = [command, "bench.toml", "--frames", "5", "--frames", ENDPOINT]
    counted, fed = with_present_names(typed)[2::2]
    assert counted in ("--frames", "--average")
    assert fed == "--feed"


def test_other_commands_and_what_follows_two_dashes_stay():
    for typed in (
        ["send", "log.csv", "--rate", "100", "--to", "udp://127.0.0.1:5561"],
        ["frame", "bench.toml", "--at", "2"],
        ["simulate", "bench.toml", "--log", "log.csv", "--frames", "3"],
        ["calibrate", "dots", "bench.toml", "--frames", "12"],
        ["service", "install", "bench.toml", "--", "--frames", ENDPOINT],
        ["replay", "bench.toml", "log.csv", "--", "--frames", ENDPOINT],
        [],
    ):
        assert with_present_names(typed) == typed


@pytest.mark.parametrize(
    ("old", "present"),
    [
        (["attitude", LOG, "--at", "1"], ["attitude", LOG, "--time", "1"]),
        (
            ["catalogue", str(DEMO), "--to=2", "-o", "stars.csv"],
            ["catalogue", str(DEMO), "--faintest", "2", "-o", "stars.csv"],
        ),
        (
            ["simulate", str(DEMO), "--radec", "1,2,3", "--rate", "0.5,0,0", "-o", "o.fits"],
            ["simulate", str(DEMO), "--radec", "1,2,3", "--slew", "0.5,0,0", "-o", "o.fits"],
        ),
    ],
    ids=lambda words: words[3],
)
def test_a_command_does_the_same_by_the_former_name(old, present, tmp_path):
    outputs = []
    for words in (old, present):
        done = run_hilstar_here(*words, "--json", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        outputs.append(json.loads(done.stdout))
    assert outputs[0] == outputs[1]


def test_a_service_takes_the_former_names_of_serve(tmp_path):
    words = ["service", "install", str(DEMO), "--print", "--", "--frames", ENDPOINT]
    done = run_hilstar_here(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert f"--feed {ENDPOINT}" in done.stdout


def test_a_refusal_names_the_present_option(tmp_path):
    refused = run_hilstar_here("attitude", LOG, "--at", "1e9", cwd=tmp_path)
    assert_refused(refused, 2, "--time 1e9")
