"""The JSON messages between the page's server and a browser; `docs/console.md` describes them.

`tools/make_page_protocol.py` makes the page's constants (`page/protocol.js`) from this file.
Numbers that JSON does not know (NaN, infinity) are sent as null.
"""

from typing import Annotated

import msgspec
from msgspec import UNSET, UnsetType

from hilstar.server.answers.judge import TrackerFigures
from hilstar.server.answers.star_widths import FocusState
from hilstar.server.console.page_figures import RunCounts

# the WebSocket's subprotocols; the token follows the second
SUBPROTOCOL, TOKEN_PROTOCOL = "hilstar", "hilstar.token."
# Close code: the page waits before it connects again, so that it does not displace another one.
GIVES_WAY = 4013
HISTORY_S = 60  # length of the charts
KEPT_EVENTS = 200
MIN_HZ, MAX_HZ = 0.1, 10.0  # bounds on a page's rate of pictures
SWITCHES = ("blank", "pause", "patch", "crosshair", "grid")  # the names in the operator's `Aids`
CONTROLS = (*SWITCHES, "ledger", "mark", "fault")
PATCH_SHARE = 0.5  # relative to white, where an order has no level


class Hello(msgspec.Struct, kw_only=True):
    """The first message to a page: the run, its monitor, and what the page may do.

    `white_level` is the largest level of a picture; `faults` are the names of the scenario's
    faults; `session` marks a first-light session; `answers` says that the run has a tracker's
    answers; `control` that the page may give orders.
    """

    version: str
    command: str
    bench: str
    renderer: str = ""
    certificate: str = ""
    started_utc: str
    resolution_px: tuple[int, int]
    white_level: int
    bits: int
    refresh_hz: float
    faults: list[str] = []
    session: bool = False
    answers: bool = False
    history_s: int = HISTORY_S
    control: bool


class SkyHealth(msgspec.Struct, frozen=True):
    """Whether the sky is right, since when (UTC), and the reasons if it is not. Also the answer of
    `GET /health`.

    `headline` is a summary in a few words. `late`: the sky is right, but frames are missed.
    """

    ok: bool
    since: str
    reasons: list[str]
    headline: str = ""
    late: bool = False


class ShownAttitude(msgspec.Struct, frozen=True, kw_only=True):
    """The attitude of the newest frame: q_icrs_to_cam (w, x, y, z), RA, Dec and roll, the rate
    about the camera's axes, and its age when the frame lit.
    """

    q: tuple[float, float, float, float]
    ra_deg: float
    dec_deg: float
    roll_deg: float
    rate_deg_s: list[float] | None
    age_ms: float


class AttitudeSource(msgspec.Struct, frozen=True):
    """The source of attitudes: the kind of link, and its endpoint."""

    kind: str
    endpoint: str


class ShownClock(msgspec.Struct, frozen=True, kw_only=True):
    """The sender's clock relative to this machine's: the offset (host minus sender) with its sigma,
    the drift, and how the clocks are compared (`mode`). `synchronised`: latencies are absolute, not
    only above the shortest one.
    """

    offset_ms: float | None
    sigma_ms: float | None
    drift_ppm: float | None
    synchronised: bool
    mode: str


class Pacing(msgspec.Struct, frozen=True):
    """Intervals between frames over the last minute: percentiles and standard deviation, ms."""

    p50_ms: float
    p99_ms: float
    sd_ms: float


class NewestFrame(msgspec.Struct, frozen=True, kw_only=True):
    """The newest frame: its number, whether no attitude has come yet (`missing`), whether its
    attitude is `stale`, whether it is `blank`, the number of `stars`, and the clipped ones by HIP
    number or name.
    """

    number: int = -1
    missing: bool = True
    stale: bool = False
    blank: bool = True
    stars: int = 0
    clipped: list[int | str] = []


class LedgerState(msgspec.Struct, frozen=True):
    """The ledger: its path, its size, and why it cannot be written now (`failing`), "" while it
    can.
    """

    path: str
    bytes: int
    failing: str = ""


class WrongCondition(msgspec.Struct, frozen=True):
    """A condition under which the sky on the display is wrong: its kind, and a line with figures
    and what to write in the bench file instead.
    """

    kind: str
    line: str


class SkyState(msgspec.Struct, frozen=True, kw_only=True):
    """The part of a run's state that the page shows unchanged. `operator` has the operator's
    switches, `faults` the names of the faults that are on.

    `wrong_sky_s` is the total time with a wrong sky, s; `pointing` a line on where the first
    attitude points; `focus` is None where neither images nor answers tell it.
    """

    attitude: ShownAttitude | None = None
    clock: ShownClock | None = None
    counts: RunCounts = RunCounts()
    frame: NewestFrame = NewestFrame()
    operator: dict[str, bool] = {}
    faults: list[str] = []
    ledger: LedgerState | None = None
    tracker: TrackerFigures | None = None
    wrong_sky: list[WrongCondition] = []
    wrong_sky_s: float = 0.0
    pointing: str = ""
    focus: FocusState | None = None


class PageState(SkyState, frozen=True, kw_only=True):
    """The state of the run that pages get ten times a second."""

    utc: str
    health: SkyHealth
    source: AttitudeSource
    pacing: Pacing | None


class ChartPoint(msgspec.Struct, kw_only=True):
    """A point of the page's charts, from the frames since the previous point: the largest times,
    and the numbers of missed frames, refused packets and wrong answers.

    `t_s` is the time since the page's process began. `x_arcsec`, `y_arcsec` and `z_arcsec` are the
    residual of the newest right answer since the previous point, `focus_px` the newest figure of
    the focus.
    """

    t_s: float
    missed: int = 0
    refused: int = 0
    age_ms: float | None = None
    interval_ms: float | None = None
    frame_ms: float | None = None
    packets_hz: float | None = None
    wrong: int = 0
    x_arcsec: float | None = None
    y_arcsec: float | None = None
    z_arcsec: float | None = None
    focus_px: float | None = None

    def take(self, key: str, value: float) -> None:
        """Set the time `key`, ms, to `value` if that is larger than the present one."""
        before = getattr(self, key)
        setattr(self, key, round(value if before is None else max(value, before), 3))


class EventLine(msgspec.Struct, frozen=True):
    """An event of the run: its UTC time, its kind, and its text."""

    utc: str
    kind: str
    line: str


class StarMark(msgspec.Struct, frozen=True, array_like=True):
    """A star of a picture, sent as an array: its position, monitor px, magnitude, HIP number (0 for
    none) and label; `clipped` is 0 or 1, `colour` a note on its colour on a coloured display.
    """

    x_px: float
    y_px: float
    v_mag: float | None
    hip: int
    label: str
    clipped: int
    colour: str = ""


class GridLine(msgspec.Struct, frozen=True):
    """A line of right ascension or declination, or a piece of one: its label, and points (x, y),
    monitor px.
    """

    label: str
    px: list[list[float]]


class Truth(msgspec.Struct, frozen=True, kw_only=True):
    """The marks of a picture, monitor px: its stars, the brightest first, the boresight, and the
    outline of the tracker's field.

    `reported_px` is the outline of the field that the tracker's newest answer reports,
    `centroids_px` its reported centroids.
    """

    frame: int
    stars: list[StarMark]
    boresight_px: list[float] | UnsetType = UNSET
    tracker_px: list[list[float]] | UnsetType = UNSET
    grid: list[GridLine] | UnsetType = UNSET
    reported_px: list[list[float]] | UnsetType = UNSET
    centroids_px: list[list[float]] | UnsetType = UNSET


class PageText(msgspec.Struct, kw_only=True, omit_defaults=True):
    """A text message to a page; it has only the keys that are set."""

    hello: Hello | None = None
    state: PageState | None = None
    history: list[ChartPoint] | None = None
    point: ChartPoint | None = None
    event: EventLine | None = None
    answer: TrackerFigures | None = None
    truth: Truth | None = None

    def json(self) -> str:
        """The message as JSON."""
        return msgspec.json.encode(self).decode()


class PictureFormat(msgspec.Struct, frozen=True, kw_only=True):
    """The head of a picture's binary message: width and height, the frame's number, and the type of
    its levels, "u1" or "u2".
    """

    w: int
    h: int
    frame: int
    dtype: str
    deflate: bool = True


class SkyPlace(msgspec.Struct, frozen=True, array_like=True):
    """A star or a body of the map of the sky, sent as an array."""

    ra_deg: float
    dec_deg: float
    v_mag: float
    label: str


class SkyMap(msgspec.Struct, frozen=True):
    """The map of the sky, the answer of `GET /sky`: stars, bodies (`moving`), and the directions of
    the screen's corners, unit vectors in camera axes ([] where the lens does not reach them).
    """

    stars: list[SkyPlace] = []
    moving: list[SkyPlace] = []
    screen_cam: list[list[float]] = []


class PageWants(msgspec.Struct):
    """What a page requests besides the state: pictures, how often, and the grid."""

    picture: bool = False
    hz: Annotated[float, msgspec.Meta(gt=0)] = 8.0
    grid: bool = False

    @property
    def picture_hz(self) -> float:
        """The requested rate of pictures, Hz, from MIN_HZ to MAX_HZ; 0 for none."""
        if self.picture:
            return min(max(self.hz, MIN_HZ), MAX_HZ)
        return 0.0


class PageMessage(msgspec.Struct):
    """A message from a page."""

    want: PageWants


class OrderBody(msgspec.Struct, forbid_unknown_fields=True):
    """The body of `POST /control/NAME`: the arguments of an order. Unknown keys are refused: a
    misspelt key must not act as a missing one.
    """

    on: bool = True
    level: float = PATCH_SHARE
    text: str = ""
    name: str = ""
