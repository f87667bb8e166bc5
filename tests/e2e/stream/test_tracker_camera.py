"""`hilstar tracker --camera` before a running display: its exposures in an outside client, and in
one of plain sockets.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.support.benches import TWIN, bench_text, still_log
from tests.support.commands import HILSTAR
from tests.support.forks import Started
from tests.support.gige_client import GigEClient, opened, own_address
from tests.support.senders import free_port
from tests.support.servers import sending_replay
from tests.support.waiting import PATIENCE_S

pytestmark = pytest.mark.e2e

SIDE_PX = TWIN["tracker"]["resolution_px"][0]
SYSTEM_PYTHON = Path("/usr/bin/python3")
ARAVIS = """
import gi, json, sys
gi.require_version("Aravis", "0.8")
from gi.repository import Aravis
camera = Aravis.Camera.new(sys.argv[1])
camera.set_exposure_time(60000.0)
stream = camera.create_stream(None, None)
for _ in range(8):
    stream.push_buffer(Aravis.Buffer.new_allocate(camera.get_payload()))
camera.start_acquisition()
numbers, brightest = [], 0
for _ in range(int(sys.argv[2])):
    buffer = stream.timeout_pop_buffer(60_000_000)
    if buffer is not None and buffer.get_status() == Aravis.BufferStatus.SUCCESS:
        numbers.append(buffer.get_frame_id())
        brightest = max(brightest, *memoryview(buffer.get_data()).cast("H"))
        stream.push_buffer(buffer)
camera.stop_acquisition()
print(json.dumps({
    "vendor": camera.get_vendor_name(), "numbers": numbers, "brightest": brightest,
    "format": camera.get_pixel_format_as_string(), "exposure_us": camera.get_exposure_time(),
}))
"""


@pytest.fixture(scope="module")
def display(tmp_path_factory):
    """A replay of one attitude that sends its frames: the bench file, and the endpoint."""
    folder = tmp_path_factory.mktemp("display")
    with sending_replay(folder, still_log(folder / "log.csv", 600)) as sending:
        yield sending


def tracker_with_camera(display, *options):
    bench, endpoint = display
    command = [*HILSTAR, "tracker", bench, "--watch", endpoint, *options, "--json"]
    return Started(
        list(map(str, command)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def ended(process):
    process.terminate()
    out, err = process.communicate(timeout=PATIENCE_S)
    return json.loads(out), err


def test_a_triggered_exposure_is_one_image_of_the_stars_that_are_lit(display):
    address = own_address()
    with (
        tracker_with_camera(display, "--camera", address) as process,
        GigEClient(address) as client,
    ):
        opened(client)
        assert client.control() == 0
        client.set("TriggerMode", 1)
        client.set("AcquisitionStart", 1)
        stamps = []
        for k in range(3):
            client.set("TriggerSoftware", 1)
            number, stamp_ns, image = client.image(SIDE_PX, SIDE_PX)
            assert number == k + 1
            stamps.append(stamp_ns)
            # Stars of Orion's belt over a background of noise.
            assert image.max() > np.median(image) + 20 * image.std() / 10
            assert np.count_nonzero(image > np.median(image) + 8 * _noise(image)) > 10
        assert stamps == sorted(stamps)
        told, _ = ended(process)
    assert told["camera"]["triggers"] == told["camera"]["images"] == 3
    assert told["answers"] == 0


def test_a_trigger_before_the_display_shows_anything_is_an_image_of_its_first_frames(tmp_path):
    bench, log = tmp_path / "bench.toml", still_log(tmp_path / "log.csv", 600)
    bench.write_text(bench_text(TWIN, {"render": {"quantisation": "round"}}))
    address, endpoint = own_address(), f"tcp://127.0.0.1:{free_port()}"
    replay = [*map(str, [*HILSTAR, "replay", bench, log, "--headless"]), "--feed", endpoint]
    with (
        tracker_with_camera((bench, endpoint), "--camera", address) as process,
        GigEClient(address) as client,
    ):
        opened(client)
        client.control()
        client.set("TriggerMode", 1)
        client.set("AcquisitionStart", 1)
        client.set("TriggerSoftware", 1)
        with Started(replay, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as display:
            number, _, image = client.image(SIDE_PX, SIDE_PX)
            assert number == 1
            assert np.count_nonzero(image > np.median(image) + 8 * _noise(image)) > 10
            ended(process)
            display.terminate()
            display.wait(PATIENCE_S)


def _noise(image: np.ndarray) -> float:
    return float(1.4826 * np.median(np.abs(image - np.median(image)))) + 1e-9


def test_it_answers_while_its_images_are_taken(display):
    address, port = own_address(), free_port()
    answering = ("--answer", f"udp://127.0.0.1:{port}", "--solver", "truth")
    with (
        tracker_with_camera(display, "--camera", address, *answering) as process,
        GigEClient(address) as client,
    ):
        opened(client)
        client.control()
        client.set("AcquisitionStart", 1)
        numbers = [client.image(SIDE_PX, SIDE_PX)[0] for _ in range(5)]
        told, _ = ended(process)
    assert numbers == [1, 2, 3, 4, 5]
    assert told["answers"] >= 5


def test_aravis_finds_it_sets_it_and_loses_no_image(display):
    """Aravis (Debian: gir1.2-aravis-0.8) is a client by others, of the whole standard."""
    probe = [SYSTEM_PYTHON, "-c", "import gi; gi.require_version('Aravis', '0.8')"]
    if (
        not SYSTEM_PYTHON.exists()
        or subprocess.run(probe, capture_output=True, check=False).returncode
    ):
        pytest.skip("Aravis is not installed (gir1.2-aravis-0.8, python3-gi)")
    address, count = own_address(), 10
    with tracker_with_camera(display, "--camera", address) as process:
        with GigEClient(address) as client:
            opened(client)
        grabbed = subprocess.run(
            [SYSTEM_PYTHON, "-c", ARAVIS, address, str(count)],
            capture_output=True,
            text=True,
            check=False,
            timeout=4 * PATIENCE_S,
        )
        assert grabbed.returncode == 0, grabbed.stderr
        told, err = ended(process)
    seen = json.loads(grabbed.stdout.splitlines()[-1])
    assert seen["vendor"] == "hilstar" and seen["exposure_us"] == 60000.0
    # Aravis gives up on an image whose lost packets come late: on a machine that stands still one
    # or two are its loss, and none the camera's.
    numbers = seen["numbers"]
    assert numbers == sorted(numbers) and len(numbers) >= count - 4, (told, err)
    assert seen["brightest"] > 100
    assert told["camera"]["dropped"] == 0


def test_aravis_s_own_test_of_cameras_finds_no_fault(display):
    """arv-camera-test-0.8 (Debian: aravis-tools) counts what a client of the whole standard got."""
    program = shutil.which("arv-camera-test-0.8")
    if program is None:
        pytest.skip("arv-camera-test-0.8 is not installed (aravis-tools)")
    address = own_address()
    with tracker_with_camera(display, "--camera", address) as process:
        with GigEClient(address) as client:
            opened(client)
        tested = subprocess.run(
            [program, "-n", address, "-e", "60000", "--duration=2"],
            capture_output=True,
            text=True,
            check=False,
            timeout=PATIENCE_S,
        )
        ended(process)
    counts = dict(re.findall(r"^(n_\w+) += (\d+)", tested.stdout, re.MULTILINE))
    assert int(counts["n_completed_buffers"]) > 0, tested.stdout + tested.stderr
    # Late packets (n_failures) and images for which it had no room (n_ignored_bytes) are a busy
    # machine's; these are a camera's that breaks the standard.
    for fault in ("n_size_mismatch_errors", "n_error_packets"):
        assert int(counts[fault]) == 0, tested.stdout
