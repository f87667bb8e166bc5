"""Where images of dots come from: files or a camera, and which dark frame is taken off."""

from __future__ import annotations

from pathlib import Path

import pytest

from hilstar.basics.resources import resource_path
from hilstar.cli.image_source import DotOptions, ImageOptions, dot_images, real_source
from hilstar.instruments.calibrate import grabbed_dots
from hilstar.instruments.calibrate.first_light import image_sources
from hilstar.instruments.calibrate.grabbed_dots import DotImages
from hilstar.server.bench.bench_file import read_bench_file
from tests.support.refusals import refusal

GIVEN, PLAN = [Path("a.png"), Path("b.png")], Path("plan.csv")
GRAB = "take {output}"
TAKEN, TAKEN_DARK, NAMED_DARK = [Path("000.png")], Path("dark_000.png"), Path("named.fits")


@pytest.fixture
def taken(monkeypatch):
    """A camera's images of the dots, and its dark frame."""

    def grab_dots(file, source, plan, exposure_s, *, overwrite, tell):
        return DotImages(TAKEN, TAKEN_DARK)

    monkeypatch.setattr(grabbed_dots, "grab_dots", grab_dots)


@pytest.mark.parametrize(
    ("options", "images", "dark"),
    [
        (DotOptions(), GIVEN, None),
        (DotOptions(dark=NAMED_DARK), GIVEN, NAMED_DARK),
        (DotOptions(grab=GRAB), TAKEN, TAKEN_DARK),
        (DotOptions(grab=GRAB, dark=NAMED_DARK), TAKEN, NAMED_DARK),
    ],
)
@pytest.mark.usefixtures("taken")
def test_a_dark_frame_that_is_named_is_used_before_one_that_is_taken(
    small_bench_file, options, images, dark
):
    given = [] if options.grab else GIVEN
    chosen = dot_images(read_bench_file(small_bench_file), given, PLAN, options)
    assert (chosen.images, chosen.dark) == (images, dark)


@pytest.mark.parametrize(
    ("options", "given", "words"),
    [
        (DotOptions(), [], "no image of the dots"),
        (DotOptions(grab=GRAB), GIVEN, "a.png: --grab takes the images"),
        (DotOptions(exposure=0.1), GIVEN, "--exposure: is for --grab"),
        (DotOptions(feed="tcp://127.0.0.1:0"), GIVEN, "--feed: is for --grab"),
    ],
)
@pytest.mark.usefixtures("taken")
def test_images_are_given_or_taken_and_what_is_of_taking_is_refused_of_files(
    small_bench_file, options, given, words
):
    file = read_bench_file(small_bench_file)
    assert words in refusal(dot_images, file, given, PLAN, options)


def test_a_camera_takes_off_the_dark_frame_that_is_named_as_a_command_does(
    monkeypatch, small_bench_file
):
    made = []
    for name in ("ByHand", "GrabCamera", "GrabCommand"):
        monkeypatch.setattr(
            image_sources, name, lambda *given, name=name: made.append((name, *given))
        )
    file = read_bench_file(small_bench_file)
    for grab in (None, "genicam:SN7", GRAB):
        real_source(file, grab, NAMED_DARK, "diode")
    assert made == [
        ("ByHand", NAMED_DARK, "diode"),
        ("GrabCamera", file, "SN7", NAMED_DARK, "diode"),
        ("GrabCommand", GRAB, NAMED_DARK, "diode"),
    ]


def test_a_truth_of_the_example_s_name_is_one_s_own_where_there_is_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = {"grab": None, "dark": None, "diode": None}
    own = ImageOptions(virtual=Path("truth-example.toml"), **options)
    assert own.truth() == resource_path("configs", "truth-example.toml")
    (tmp_path / "truth-example.toml").write_text("")
    assert own.truth() == Path("truth-example.toml")
    assert ImageOptions(virtual=Path("other.toml"), **options).truth() == Path("other.toml")
