"""Basilisk's live stream: a frame for each step of the simulation, and the tracker's picture where a camera asks for it."""

from __future__ import annotations

import time
from collections.abc import Callable

from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.attitude.wire.vizard import ImageRequest, Step, TrackerCamera, VizardLive, disagreement
from hilstar.attitude.wire.vizard_message import VizCamera
from hilstar.notices import Notices
from hilstar.run.lockstep.steps import POLL_MS, Steps
from hilstar.run.loop import FrameLoop
from hilstar.run.summary import RunSummary

# The picture (a PNG) of the tracker at an attitude, for a simulation that asks for it.
Pictures = Callable[[AttitudeSample], bytes]


class Cameras:
    """Answers what Basilisk's cameras ask for: the picture of the attitude of the last step, or none before the first."""

    def __init__(self, tracker: TrackerCamera, pictures: Pictures | None, notices: Notices) -> None:
        self._tracker, self._pictures, self._notices = tracker, pictures, notices
        self._sample: AttitudeSample | None = None
        self._described: dict[int, VizCamera] = {}
        self._looked_at: set[int] = set()

    def see(self, step: Step) -> None:
        """Take the attitude of a step, and its cameras."""
        self._sample = step.event if isinstance(step.event, AttitudeSample) else None
        for camera in () if step.update is None else step.update.cameras:
            self._described[camera.identity] = camera

    def picture(self, request: ImageRequest) -> bytes:
        """The answer to a request; empty where there is no picture."""
        described = self._described.get(request.camera)
        if described is not None and request.camera not in self._looked_at:
            self._looked_at.add(request.camera)
            trouble = disagreement(described, self._tracker)
            if trouble is not None:
                self._notices.tell("other-camera", trouble)
        if self._sample is None or self._pictures is None:
            return b""
        return self._pictures(self._sample)


def serve_vizard(link: VizardLive, run: Steps, loop: FrameLoop, cameras: Cameras) -> RunSummary:
    """Answer Basilisk up to the limit, or until a signal; returns the summary. A step that is refused ends its simulation."""
    while run.goes_on():
        request = link.receive(POLL_MS)
        if request is None:
            loop.idle()
        elif isinstance(request, ImageRequest):
            link.answer_image(cameras.picture(request))
        else:
            refusal = run.take(request.host_ns, request.event, request.raw)
            cameras.see(request)
            link.answer_step(refusal is None)
            run.answered(request.host_ns, time.monotonic_ns())
    return run.summary()
