"""hilstar tracker from its words to its parts, which are the test's: who gets an answer, by which
seeds its noise comes, and what it says of itself.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hilstar.basics.running_statistics import Percentiles
from hilstar.instruments.simulate.tracker_process import Planted
from hilstar.server.answers.answer import Answer
from hilstar.server.gige.camera import CameraCounts
from hilstar.server.gige.control import ControlCounts
from tests.support.benches import bench_text
from tests.support.commands import run_hilstar_here

Q = np.array([0.5, -0.5, 0.5, -0.5])
ANSWERS = (Answer(5, b"", 1_500_000_000, Q), Answer(6, b"", 2_000_000_000, None, valid=False))
NO_TIME = Percentiles(None, None, None)


class Part:
    """A part of the tracker: what it was made of, and that it was closed."""

    def __init__(self, *made_of: Any, **more: Any) -> None:
        self.made_of, self.more = made_of, more
        self.closed = False

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *_: object) -> None:
        self.closed = True


class Parts(dict[str, Any]):
    """The parts by their names, as the command made them."""

    def maker(self, name: str, **fields: Any) -> Any:
        """A class whose newest instance is a part of that name."""

        def make(*made_of: Any, **more: Any) -> Part:
            self[name] = Part(*made_of, **more)
            for key, value in fields.items():
                setattr(self[name], key, value)
            return self[name]

        return make


@pytest.fixture
def parts(monkeypatch: pytest.MonkeyPatch) -> Iterator[Parts]:
    """The parts, in place of the real ones."""
    made = Parts()
    counts = SimpleNamespace(received=60, missing=2)
    sent: list[Answer] = []

    class Process:
        def __init__(self, *made_of: Any) -> None:
            made["process"] = self
            self.made_of = made_of
            summary = {
                "answers": 2, "valid": 1, "passed_over": 0, "modes": {}, "cpu_ms": NO_TIME,
                "latency_ms": NO_TIME, "own_bias_arcsec": None,
            }  # fmt: skip
            self.tally = SimpleNamespace(summary=lambda: summary)

        def run(self, send: Any, stop: Any, seconds: float) -> None:
            self.seconds, self.has_link = seconds, send is not None
            for answer in ANSWERS if send is not None else ():
                send(answer)

    simulate = "hilstar.instruments.simulate"
    heard = SimpleNamespace(counts=ControlCounts(commands=4))
    camera_counts = {"counts": CameraCounts(images=3), "channel": heard}
    for place, maker in (
        ("hilstar.attitude.wire.shown_frames.FrameWatch", made.maker("frames", verb="connects to a sender", refused=1)),
        (f"{simulate}.live_exposure.LiveTracker", made.maker("live", frames=counts)),
        (f"{simulate}.answer_link.AnswerLink", made.maker("link", endpoint="udp://a:1", sent=2, babbled=7, send=sent.append)),
        ("hilstar.server.gige.camera.GigECamera", made.maker("camera", **camera_counts)),
        (f"{simulate}.tracker_process.TrackerProcess", Process),
    ):  # fmt: skip
        monkeypatch.setattr(place, maker)
    made["sent"] = sent
    yield made
    assert made["frames"].closed and made["live"].closed


def tracker(folder: Path, *words: str) -> Any:
    """The command's end, before frames from tcp://x:1."""
    changes = {"tracker": {"exposure_s": 0.05, "resolution_px": [900, 600]}}
    (folder / "bench.toml").write_text(bench_text(changes))
    line = ["tracker", "bench.toml", "--watch", "tcp://x:1", *words]
    return run_hilstar_here(*line, cwd=folder)


def test_answers_go_to_their_target_and_into_the_table_and_are_counted(
    tmp_path: Path, parts: Parts
) -> None:
    words = ["--answer", "udp://a:1", "--format", "json", "--solver", "truth", "--rate", "5"]
    words += ["--bias", "1,2,3", "--duration", "2.5", "--record", "t.csv", "--json"]
    done = tracker(tmp_path, *words)
    assert done.returncode == 0, done.stderr
    assert parts["sent"] == list(ANSWERS)
    assert len((tmp_path / "t.csv").read_text().splitlines()) == 3
    told = json.loads(done.stdout)
    assert told["frames"] == {"received": 60, "missing": 2, "refused": 1}
    assert told["link"] == {"endpoint": "udp://a:1", "sent": 2, "babbled": 7}
    assert "camera" not in told
    assert "connects to frames tcp://x:1; answers 5 Hz, json, to udp://a:1" in done.stderr
    process = parts["process"]
    live, frames, planted, rate_hz, _, gige = process.made_of
    assert (live, frames, gige) == (parts["live"], parts["frames"], None)
    assert (planted, rate_hz, process.seconds) == (Planted(bias_arcsec=(1.0, 2.0, 3.0)), 5.0, 2.5)
    target, form, connect, babbler = parts["link"].made_of
    assert (target, form, connect, babbler) == ("udp://a:1", "json", False, None)
    assert parts["live"].lost_in_space is None


def test_a_camera_alone_answers_nobody_and_is_the_tracker_s(tmp_path: Path, parts: Parts) -> None:
    done = tracker(tmp_path, "--camera", "127.0.0.5", "--json")
    assert done.returncode == 0, done.stderr
    process = parts["process"]
    assert not process.has_link and process.seconds == float("inf")
    assert parts["sent"] == [] and "link" not in parts
    assert process.made_of[-1] is parts["camera"]
    told = json.loads(done.stdout)["camera"]
    assert (told["images"], told["commands"]) == (3, 4)
    identity, settings, allowed, _ = parts["camera"].made_of
    assert (str(identity.address), identity.model) == ("127.0.0.5", "virtual tracker")
    assert (settings.width_px, settings.height_px) == (900, 600)
    assert (settings.exposure_s, settings.rate_hz) == (0.05, 10.0)
    assert not allowed
    assert "a GigE Vision camera at 127.0.0.5" in done.stderr


def test_noise_chance_and_garbage_have_seeds_of_their_own(tmp_path: Path, parts: Parts) -> None:
    words = ["--answer", "udp://a:1", "--solver", "truth", "--seed", "7"]

    def drawn() -> list[float]:
        tracker(tmp_path, *words, "--babble")
        _, noise = parts["live"].made_of
        chance = parts["process"].made_of[4]
        babbler = parts["link"].made_of[3]
        return [generator.random() for generator in (noise, chance, babbler)]

    first, again = drawn(), drawn()
    assert first == again and len(set(first)) == 3
    words[-1] = "8"
    assert not set(drawn()) & set(first)


def test_a_camera_for_other_machines_says_which(tmp_path: Path, parts: Parts) -> None:
    refused = tracker(tmp_path, "--camera", "192.168.1.5")
    assert refused.returncode == 2
    assert "nothing says which may use it; write --allow ADDRESS" in refused.stderr


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ([], "nothing is to be given: write --answer TARGET, --camera, or both"),
        (["--answer", "udp://a:1", "--format", "xml"], "--format xml: write "),
        (["--answer", "udp://a:1", "--rate", "21"], "--rate 21: write 0.01 to 20 Hz"),
        (["--answer", "udp://a:1", "--bias", "1,2,1e6"], "write at most 100000 arcsec"),
        (["--answer", "udp://a:1", "--bias=1,-1e6,2"], "write at most 100000 arcsec"),
        (["--answer", "udp://a:1", "--silent", "soon"], "--silent soon: write seconds"),
    ],
)
def test_words_of_a_tracker_that_cannot_be_are_refused(
    tmp_path: Path, words: list[str], line: str
) -> None:
    refused = tracker(tmp_path, *words)
    assert refused.returncode == 2 and line in refused.stderr
