"""[monitor]."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from hilstar.bench.config.values import NotNegative, Positive, Size
from hilstar.toml_tables import Table

MS_PER_S = 1000.0
ONE_PERIOD = {"default": "one refresh period"}


class Monitor(Table, frozen=True):
    """The screen behind the collimator.

    The window opens for `serve` and `replay` unless `--headless` is given; `--windowed` keeps it on the desktop. At the start
    120 frames are measured. A display is refused (exit code 3), unless `--force` is given, when its size or refresh rate
    differs from the bench file, when it has fewer bits, when it is scaled, composited or mirrored by another display, when it
    drops frames, or when it does not wait for its refresh. A display that is unplugged is filled again when it returns.

    Keys in the window: q quit, b blank, space pause, c crosshair, g grid, t next test pattern, h help. Frames whose sky was
    changed with these keys are counted as `operator`; frames while the window was minimised, covered, moved off its display,
    or on a display that slept are counted as `hidden`. The status, the ledger's frames and events, and `--json` have both
    counts, in frames and in seconds.

    A frame is drawn for the moment at which the middle row lights: the buffer swap plus `panel_delay_ms` plus half of
    `scanout_ms`. A star on another row is drawn where it is when that row lights, and along its path for `hold_ms`.

    To measure `panel_delay_ms`, put a photodiode in front of the square that `photodiode_px` draws, run
    `serve --ledger RUN.mcap`, and meanwhile `hilstar latency RUN.mcap --diode serial:/dev/ttyACM0@115200 --write BENCH.toml`.
    The photodiode's device sends a line `1` at each edge from dark to light and `0` at each edge back, or `1,MICROSECONDS`
    by its own clock. `--edges FILE.csv` takes recorded edges instead (`host_ns,level`, on the host's monotonic clock).
    """

    resolution_px: Annotated[Size, Meta(description="Size of the screen.")]
    pixel_pitch_um: Annotated[Positive, Meta(description="Distance between the centres of adjacent pixels.")]
    refresh_hz: Annotated[float, Meta(ge=0.01, le=1000, description="Refresh rate; headless, the frame rate.")] = 60.0
    bits: Annotated[int, Meta(ge=1, le=16, description="Bits of a code value.")] = 8
    calibration: Annotated[
        str,
        Meta(
            description='Light as a function of the code value: `"srgb"`, `"gamma2.2"`, `"lcd-example"` (invented, with a '
            "black level and vignetting), or the path of a file that `hilstar calibrate photometric` wrote (see "
            "[CALIBRATION.md](../configs/CALIBRATION.md))."
        ),
    ] = "srgb"
    display: Annotated[
        int | str,
        Meta(description="Which display the window fills: its index, or a part of its name. `hilstar doctor` lists them."),
    ] = 0
    flip_x: Annotated[bool, Meta(description="The optics mirror left and right: the columns of the screen are reversed.")] = (
        False
    )
    flip_y: Annotated[bool, Meta(description="The optics mirror up and down: the rows of the screen are reversed.")] = False
    rotate_deg: Annotated[Literal[0, 90, 180, 270], Meta(description="Turns the image clockwise on the screen.")] = 0
    panel_delay_ms: Annotated[
        NotNegative, Meta(description="From the buffer swap to the light of the first row. `hilstar latency` measures it.")
    ] = 0.0
    scanout_ms: Annotated[
        NotNegative | None,
        Meta(
            description="How long the panel takes to light its rows, first to last; 0 where all rows light at once.",
            extra=ONE_PERIOD,
        ),
    ] = None
    hold_ms: Annotated[
        NotNegative | None,
        Meta(description="How long a row stays lit; 0 for a panel that flashes.", extra=ONE_PERIOD),
    ] = None
    photodiode_px: Annotated[
        int, Meta(ge=0, le=1000, description="Side of a square for a photodiode in the lower left corner; 0 for none.")
    ] = 0
    photodiode: Annotated[
        Literal["toggle", "code"],
        Meta(
            description='`"toggle"`: the square is white in every other frame. `"code"`: it follows a sequence in which any '
            "7 consecutive frames identify themselves."
        ),
    ] = "toggle"

    @property
    def period_ms(self) -> float:
        """One refresh period, in milliseconds."""
        return MS_PER_S / self.refresh_hz

    @property
    def panel_scanout_ms(self) -> float:
        """`scanout_ms`, or its default."""
        return self.period_ms if self.scanout_ms is None else self.scanout_ms

    @property
    def panel_hold_ms(self) -> float:
        """`hold_ms`, or its default."""
        return self.period_ms if self.hold_ms is None else self.hold_ms
