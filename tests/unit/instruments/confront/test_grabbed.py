"""confront with photographs that it takes itself: by a command, and by a camera."""

from __future__ import annotations

import json
import shlex
import sys
import time
from contextlib import closing

import numpy as np
import pytest
from astropy.io import fits
from PIL import Image

from hilstar.basics.fits_headers import read_fits_image
from hilstar.instruments.calibrate.first_light.image_sources import GrabCamera
from hilstar.instruments.confront import page
from hilstar.instruments.confront.images import read_photographs
from hilstar.instruments.confront.measured_bench import read_tracker_file
from hilstar.server.genicam.camera import has_aravis
from hilstar.server.gige.registers import CameraSettings
from tests.support.commands import run_hilstar_here
from tests.support.gige_cameras import fake_camera, running_camera
from tests.support.planted_sky import HEIGHT, SKY, WIDTH, Planted, photograph, write_bench

needs_aravis = pytest.mark.skipif(
    not has_aravis(), reason="Aravis is not installed (gir1.2-aravis-0.8, python3-gi)"
)
AT = ("--at", "2020-01-01T00:00:00")  # of the planted stars' places


@pytest.fixture(scope="module")
def planted(tmp_path_factory):
    """A folder with a guess of a camera and one of its photographs."""
    folder = tmp_path_factory.mktemp("planted")
    image = photograph(Planted(), SKY.pointings[1], np.random.default_rng(5))
    Image.fromarray(image).save(folder / "sky.png", compress_level=1)
    write_bench(folder / "guess.toml")
    return folder, image


@pytest.fixture(scope="module")
def by_command(planted):
    """The camera by the photograph that a command takes, a copy of the planted file."""
    folder, _ = planted
    script = folder / "grab.py"
    script.write_text(
        "import shutil, sys\n"
        "assert float(sys.argv[2]) == 0.25\n"
        f"shutil.copy({str(folder / 'sky.png')!r}, sys.argv[1])\n"
    )
    grab = f"{shlex.quote(sys.executable)} {script} {{output}} {{exposure_s}}"
    words = ("--grab", grab, "--exposure", "0.25", "--count", "1")
    return confronted(folder, *words, "-o", folder / "by_command", *AT)["camera"]


def confronted(folder, *words):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page, "_charts", lambda *given: [])
        done = run_hilstar_here("confront", folder / "guess.toml", *words, "--json")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@needs_aravis
def test_a_cameras_photograph_gives_what_a_commands_gives(planted, by_command, tmp_path):
    folder, image = planted
    settings = CameraSettings(WIDTH, HEIGHT, 16, 0.05, 10.0)
    with running_camera(settings, lambda k: image) as address:
        before_ns = time.time_ns()
        found = confronted(
            folder, "--grab", f"genicam:{address}", "--count", "1", "-o", tmp_path, *AT
        )
        after_ns = time.time_ns()
    (path,) = (tmp_path / "images").iterdir()
    np.testing.assert_array_equal(fits.getdata(path), image)
    (photo,) = read_photographs(path, (WIDTH, HEIGHT))
    assert photo.exposure_s == pytest.approx(0.2)
    # The camera of this test exposes nothing: its image comes an exposure too early.
    assert before_ns < photo.t_ns + 100_000_000 < after_ns
    assert found["camera"] == by_command


def test_a_command_takes_photographs_too(planted, by_command):
    folder, _ = planted
    (path,) = (folder / "by_command" / "images").iterdir()
    assert path.read_bytes() == (folder / "sky.png").read_bytes()
    error_px = abs(by_command["focal_length_px"] - Planted().focal_px)
    assert error_px < 3 * by_command["sigma"]["focal_length_px"]


@needs_aravis
def test_a_camera_that_sees_no_stars_is_told_in_one_line(tmp_path):
    bench = write_bench(tmp_path / "guess.toml")
    bench.write_text(bench.read_text().replace(f"[{WIDTH}, {HEIGHT}]", "[512, 512]"))
    with fake_camera() as address:
        done = run_hilstar_here(
            "confront", bench, "--grab", f"genicam:{address}", "--count", "1", "-o", tmp_path / "o"
        )
    assert done.returncode == 2
    assert "hilstar: " in done.stderr.splitlines()[-1]


@needs_aravis
def test_a_mosaic_is_written_as_the_camera_names_it(tmp_path):
    bench = write_bench(tmp_path / "guess.toml")
    text = bench.read_text().replace(f"[{WIDTH}, {HEIGHT}]", "[512, 512]")
    bench.write_text(f'{text}\n[tracker.camera]\npixel_format = "BayerGR8"\n')
    with (
        fake_camera() as address,
        closing(GrabCamera(read_tracker_file(bench)[0], address)) as source,
    ):
        path = source.photograph(tmp_path / "mosaic", 0.01)
    assert read_fits_image(path.read_bytes()).bayer == "GRBG"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ((), "no image; give files, or --grab"),
        (("--count", "3"), "--count: is for --grab"),
        (("sky.png", "--grab", "genicam:"), "sky.png: --grab takes the images"),
        (("--grab", "cp a b"), "has no {output}"),
        (("--grab", "cp {pattern} {output}"), "has {pattern}, and nothing is shown here"),
        (("--grab", "cp a {output}", "--exposure", "1"), "--grab has no {exposure_s}"),
    ],
)
def test_what_does_not_fit_together_is_refused(planted, tmp_path, words, says):
    folder, _ = planted
    words = [str(folder / word) if word == "sky.png" else word for word in words]
    done = run_hilstar_here("confront", folder / "guess.toml", *words, "-o", tmp_path / "out")
    assert done.returncode == 2
    assert says in done.stderr and done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()
