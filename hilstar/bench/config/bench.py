"""The whole bench file."""

from __future__ import annotations

import msgspec

from hilstar.bench.config.background import Background
from hilstar.bench.config.collimator import Collimator
from hilstar.bench.config.faults import FaultSettings
from hilstar.bench.config.monitor import Monitor
from hilstar.bench.config.render import MAX_JUDGED_FRAMES, RenderSettings
from hilstar.bench.config.sky import SkySettings
from hilstar.bench.config.spacecraft import Spacecraft
from hilstar.bench.config.stream.attitude import AttitudeSettings
from hilstar.bench.config.sync import SyncSettings
from hilstar.bench.config.tracker import Tracker
from hilstar.bench.config.verify import Verify
from hilstar.toml_tables import Table

TYPE_WORDS = {"float": "number", "int": "whole number", "str": "text", "object": "table", "bool": "true or false"}


class BenchConfig(Table, frozen=True):
    """A whole bench file."""

    tracker: Tracker
    monitor: Monitor
    collimator: Collimator
    sky: SkySettings = msgspec.field(default_factory=SkySettings)
    spacecraft: Spacecraft = msgspec.field(default_factory=Spacecraft)
    attitude: AttitudeSettings = msgspec.field(default_factory=AttitudeSettings)
    render: RenderSettings = msgspec.field(default_factory=RenderSettings)
    background: Background = msgspec.field(default_factory=Background)
    verify: Verify = msgspec.field(default_factory=Verify)
    sync: SyncSettings = msgspec.field(default_factory=SyncSettings)
    faults: FaultSettings = msgspec.field(default_factory=FaultSettings)

    @property
    def exposure_frames(self) -> int:
        """The frames of the tracker's exposure by which `temporal` is judged."""
        if self.render.cycle_frames is not None:
            return self.render.cycle_frames
        return min(max(1, round(self.tracker.exposure_s * self.monitor.refresh_hz)), MAX_JUDGED_FRAMES)
