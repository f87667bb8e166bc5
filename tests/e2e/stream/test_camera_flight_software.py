"""Flight software before the virtual tracker's camera: its images are those of `simulate` bit for
bit, and `assess` judges the attitudes that it finds in them.
"""

from __future__ import annotations

import json
import subprocess

import numpy as np
import pytest
from astropy.io import fits

from hilstar.attitude.wire.shown_frames import FrameWatch
from hilstar.basics.rotation import from_radec_roll_deg, from_rotation_vector, multiply
from hilstar.cli.tracker import solver_of
from hilstar.instruments.simulate.live_exposure import LiveTracker
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.genicam.camera import SYSTEM_PYTHON, has_aravis
from hilstar.server.genicam.pixels import unpacked
from hilstar.server.gige.registers import CameraSettings
from hilstar.tracker.centroids import CentroidSettings, find_stars
from hilstar.tracker.identify import FoundStars
from tests.support.benches import TWIN, bench_text, still_log
from tests.support.commands import HILSTAR, run_hilstar_here
from tests.support.forks import Started
from tests.support.gige_cameras import running_camera
from tests.support.gige_client import GigEClient, opened, own_address
from tests.support.senders import free_port
from tests.support.waiting import PATIENCE_S, wait_for

pytestmark = pytest.mark.e2e

SIDE_PX = TWIN["tracker"]["resolution_px"][0]
SWING_DEG, SWING_S = 0.5, 4.0  # at most 0.8 deg/s: 1.3 px in an exposure
IMAGES = 60
FRAMES, TRIGGERS = 8, 6
# Of the tracker alone: 400 x 400 pixels of 107 arcsec, some 20 stars; measured 0.6 and 0.9 arcsec.
OWN_ARCSEC = (10.0, 10.0, 60.0)
MAX_CLOCK_MS = 2.0
HELD_S = 0.2


def swing_log(path, seconds):
    """A slow swing about Orion's belt: a turn at one rate would not tell a clock from a bias."""
    q, lines = from_radec_roll_deg(84.057, -1.2, 0.0), ["t_s,qw,qx,qy,qz"]
    for k in range(round(seconds * 50) + 1):
        phase = 2 * np.pi * k / 50 / SWING_S
        turn = np.radians(SWING_DEG) * np.array([np.sin(phase), np.cos(0.7 * phase), 0.0])
        swung = multiply(from_rotation_vector(turn), q)
        lines.append(f"{k / 50}," + ",".join(repr(float(part)) for part in swung))
    path.write_text("\n".join(lines) + "\n")
    return path


class FlightSoftware:
    """Attitudes from images alone: stars by their centroids, identified by tetra3rs."""

    def __init__(self, bench):
        with LiveTracker(read_bench_file(bench), np.random.default_rng(0)) as live:
            self._camera = live.camera
            self._solve = solver_of("tetra3", live)

    def attitude(self, image):
        """q_icrs_to_cam of an image; None where it tells none."""
        stars = find_stars(image.astype(float), CentroidSettings(window_sigma_px=1.0))
        inside = ~stars.at_edge
        x_px, y_px = stars.x_px[inside], stars.y_px[inside]
        rays = self._camera.rays(x_px, y_px)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        return self._solve(FoundStars(x_px, y_px, stars.flux[inside], rays), image)


@pytest.mark.usefixtures("without_charts")
def test_flight_software_before_the_camera_is_assessed(tmp_path):
    bench, endpoint = tmp_path / "bench.toml", f"tcp://127.0.0.1:{free_port()}"
    bench.write_text(
        bench_text(TWIN, {"render": {"quantisation": "round"}, "tracker": {"exposure_s": 0.05}})
    )
    flight = FlightSoftware(bench)
    ledger, address = tmp_path / "run.mcap", own_address()
    replay = [*HILSTAR, "replay", bench, swing_log(tmp_path / "log.csv", 120.0), "--headless"]
    replay += ["--feed", endpoint, "--ledger", ledger]
    watcher = [*HILSTAR, "tracker", bench, "--watch", endpoint, "--camera", address, "--json"]
    quiet = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with (
        Started(list(map(str, replay)), **quiet) as display,
        Started([*map(str, watcher), "--clock-offset", "7"], **quiet) as tracker,
        GigEClient(address) as client,
    ):
        opened(client)
        client.control()
        client.set("AcquisitionStart", 1)
        images = [client.image(SIDE_PX, SIDE_PX) for _ in range(IMAGES)]
        tracker.terminate()
        told, err = tracker.communicate(timeout=PATIENCE_S)
        display.terminate()
        display.communicate(timeout=PATIENCE_S)
    assert json.loads(told)["camera"]["dropped"] == 0, err
    rows = ["t_s,qw,qx,qy,qz,valid"]
    for _, stamp_ns, image in images:
        q = flight.attitude(image)
        numbers = ",,," if q is None else ",".join(repr(float(part)) for part in q)
        rows.append(f"{stamp_ns / 1e9:.9f},{numbers},{int(q is not None)}")
    telemetry = tmp_path / "telemetry.csv"
    telemetry.write_text("\n".join(rows) + "\n")
    words = ("-o", tmp_path / "budget", "--stamp", "start", "--display-attitudes", "2", "--json")
    assessed = run_hilstar_here("assess", ledger, telemetry, *words)
    assert assessed.returncode == 0, assessed.stderr
    # A machine that stands still for a second loses images: the camera keeps 8 of them.
    numbers = [number for number, _, _ in images]
    assert numbers == sorted(set(numbers)) and numbers[-1] <= 1.1 * IMAGES
    found = json.loads(assessed.stdout)
    assert np.all(np.abs(found["bias_arcsec"]) < OWN_ARCSEC)
    assert found["availability"] > 0.9
    assert found["clock"]["sigma_ms"] < MAX_CLOCK_MS
    # Where a busy machine held a frame of the display, its sky stood still for a while.
    assert all(wrong["off_deg"] < HELD_S * SWING_DEG for wrong in found["wrong"])


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """The frames of `simulate` along a log, DN, and the bench's detector."""
    folder = tmp_path_factory.mktemp("simulated")
    detector = {"read_noise_e": 8.0, "offset_dn": 100.0, "dark_e_per_s": 20.0, "prnu": 0.01}
    (folder / "bench.toml").write_text(bench_text(TWIN, {"tracker.detector": detector}))
    words = ("--log", swing_log(folder / "log.csv", 4.0), "--frames", str(FRAMES), "--seed", "7")
    drawn = run_hilstar_here("simulate", folder / "bench.toml", *words, "-o", folder / "frames")
    assert drawn.returncode == 0, drawn.stderr
    frames = [fits.getdata(path) for path in sorted((folder / "frames").glob("*.fits"))]
    assert len(frames) == FRAMES and len({frame.tobytes() for frame in frames}) == FRAMES
    return frames


GRABBER = """
import gi, json, sys
gi.require_version("Aravis", "0.8")
from gi.repository import Aravis
camera = Aravis.Camera.new(sys.argv[1])
camera.set_pixel_format_from_string(sys.argv[2])
stream = camera.create_stream(None, None)
for _ in range(40):
    stream.push_buffer(Aravis.Buffer.new_allocate(camera.get_payload()))
camera.start_acquisition()
numbers = []
with open(sys.argv[4], "wb") as output:
    for _ in range(int(sys.argv[3])):
        buffer = stream.timeout_pop_buffer(60_000_000)
        if buffer is not None and buffer.get_status() == Aravis.BufferStatus.SUCCESS:
            numbers.append(buffer.get_frame_id())
            output.write(buffer.get_data())
            stream.push_buffer(buffer)
camera.stop_acquisition()
print(json.dumps(numbers))
"""


@pytest.mark.skipif(
    not has_aravis(), reason="Aravis is not installed (gir1.2-aravis-0.8, python3-gi)"
)
@pytest.mark.parametrize("form", ["Mono12", "Mono12Packed", "Mono16"])
def test_the_frames_of_simulate_come_through_the_camera_bit_for_bit(simulated, tmp_path, form):
    settings = CameraSettings(SIDE_PX, SIDE_PX, 12, 0.04, 20.0)
    count, taken = 2 * FRAMES, tmp_path / "taken"
    with running_camera(settings, lambda k: simulated[k % FRAMES]) as address:
        command = [SYSTEM_PYTHON, "-c", GRABBER, address, form, str(count), taken]
        run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    numbers = json.loads(run.stdout.splitlines()[-1])
    # Aravis gives up on an image whose lost packets come late, on a machine that stands still.
    assert numbers == sorted(numbers) and len(numbers) >= count - 4
    data = taken.read_bytes()
    size = len(data) // len(numbers)
    images = [
        unpacked(data[k * size : (k + 1) * size], form, SIDE_PX, SIDE_PX)
        for k in range(len(numbers))
    ]
    first = next(k for k in range(FRAMES) if np.array_equal(images[0], simulated[k]))
    for number, image in zip(numbers, images, strict=True):
        frame = simulated[(first + number - numbers[0]) % FRAMES]
        np.testing.assert_array_equal(image, frame, err_msg=f"image {number}")


def test_the_trackers_images_are_those_of_its_simulator_with_its_seed(tmp_path):
    """The display stands still, so the light of each exposure is one; noise is the seed's."""
    bench, endpoint = tmp_path / "bench.toml", f"tcp://127.0.0.1:{free_port()}"
    detector = {"read_noise_e": 8.0, "offset_dn": 100.0, "dark_e_per_s": 20.0, "prnu": 0.01}
    render = {"quantisation": "round"}
    bench.write_text(bench_text(TWIN, {"render": render, "tracker.detector": detector}))
    address = own_address()
    replay = [*HILSTAR, "replay", bench, still_log(tmp_path / "log.csv", 600), "--headless"]
    watcher = [*HILSTAR, "tracker", bench, "--watch", endpoint, "--camera", address]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with (
        Started([*map(str, replay), "--feed", endpoint], **quiet) as display,
        Started([*map(str, watcher), "--seed", "5"], **quiet) as tracker,
        FrameWatch(endpoint) as watch,
        GigEClient(address) as client,
    ):
        opened(client)
        client.control()
        client.set("TriggerMode", 1)
        client.set("AcquisitionStart", 1)
        images = []
        for _ in range(TRIGGERS):
            client.set("TriggerSoftware", 1)
            images.append(client.image(SIDE_PX, SIDE_PX)[2])
        frames = []
        wait_for(lambda: frames.extend(watch.frames(100)) or frames, "a frame comes")
        tracker.terminate()
        display.terminate()
        tracker.wait(PATIENCE_S)
        display.wait(PATIENCE_S)
    noise = np.random.default_rng(np.random.SeedSequence(5).spawn(3)[0])
    with LiveTracker(read_bench_file(bench), noise) as live:
        live.take(frames[0])
        lit_ns = live.frames.newest_ns
        exposed = live.frames.exposed(lit_ns, lit_ns + round(live.exposure_s * 1e9))
        for k, image in enumerate(images):
            np.testing.assert_array_equal(image, live.expose(exposed), err_msg=f"image {k}")
