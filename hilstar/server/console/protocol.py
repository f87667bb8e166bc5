"""What the page's server and a browser say to each other, as JSON: `docs/console.md` has the
same for a reader.

`tools/make_page_protocol.py` makes the page's constants (`page/protocol.js`) from this file.
Numbers that JSON does not know (NaN, infinity) are sent as null.
"""

from typing import Annotated

import msgspec
from msgspec import UNSET, UnsetType

from hilstar.server.answers.judge import TrackerFigures
from hilstar.server.console.page_figures import RunCounts

# the WebSocket's subprotocols; the token follows the second
SUBPROTOCOL, TOKEN_PROTOCOL = "hilstar", "hilstar.token."
# close code: the page waits before it comes back, so as not to displace the next one
GIVES_WAY = 4013
HISTORY_S = 60  # length of the charts
KEPT_EVENTS = 200
MIN_HZ, MAX_HZ = 0.1, 10.0  # bounds on a page's rate of pictures
SWITCHES = ("blank", "pause", "patch", "crosshair", "grid")  # as `run.aids` has them
CONTROLS = (*SWITCHES, "ledger", "mark", "fault")
PATCH_SHARE = 0.5  # relative to white, where an order has no level


class Hello(msgspec.Struct, kw_only=True):
    """What a page is told first: the run, its monitor, and what the page may do."""

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
    """Whether the sky is right, since when (UTC), and why not. Also the answer of `GET /health`.

    `headline` says it in a few words. `late`: the sky itself is right, and its frames are missed.
    """

    ok: bool
    since: str
    reasons: list[str]
    headline: str = ""
    late: bool = False


class ShownAttitude(msgspec.Struct, frozen=True, kw_only=True):
    """The attitude of the newest frame: q_icrs_to_cam, its pointing, its rate in cam, and its
    age at light.
    """

    q: tuple[float, float, float, float]
    ra_deg: float
    dec_deg: float
    roll_deg: float
    rate_deg_s: list[float] | None
    age_ms: float


class AttitudeSource(msgspec.Struct, frozen=True):
    """Where attitudes come from: the kind of link, and its endpoint."""

    kind: str
    endpoint: str


class ShownClock(msgspec.Struct, frozen=True, kw_only=True):
    """The sender's clock against this machine's."""

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
    """The newest frame; `clipped` has HIP numbers, and names of bodies."""

    number: int = -1
    missing: bool = True
    stale: bool = False
    blank: bool = True
    stars: int = 0
    clipped: list[int | str] = []


class LedgerState(msgspec.Struct, frozen=True):
    """The ledger: `failing` says why it cannot be written now, "" where it can."""

    path: str
    bytes: int
    failing: str = ""


class WrongCondition(msgspec.Struct, frozen=True):
    """A condition under which the sky that is shown is wrong: its kind, a line with figures and
    what to write instead.
    """

    kind: str
    line: str


class SkyState(msgspec.Struct, frozen=True, kw_only=True):
    """What a run tells of itself and the page shows as it is; `operator` has the switches, `faults`
    those that are on.

    `wrong_sky_s` is for how long the sky has been wrong in all, `pointing` where the first attitude
    points.
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


class PageState(SkyState, frozen=True, kw_only=True):
    """The run as the page shows it, ten times a second."""

    utc: str
    health: SkyHealth
    source: AttitudeSource
    pacing: Pacing | None


class ChartPoint(msgspec.Struct, kw_only=True):
    """What the frames since the point before add to the charts: the largest times, and how many
    went wrong.

    `x_arcsec`, `y_arcsec` and `z_arcsec` are the residual of the newest right answer since then.
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

    def take(self, key: str, value: float) -> None:
        """Keep the larger of the time that is there and `value`, ms."""
        before = getattr(self, key)
        setattr(self, key, round(value if before is None else max(value, before), 3))


class EventLine(msgspec.Struct, frozen=True):
    """An event of the run at UTC."""

    utc: str
    kind: str
    line: str


class StarMark(msgspec.Struct, frozen=True, array_like=True):
    """A star of a picture, as an array; `clipped` is 0 or 1, and `colour` what a coloured
    display shows of it.
    """

    x_px: float
    y_px: float
    v_mag: float | None
    hip: int
    label: str
    clipped: int
    colour: str = ""


class GridLine(msgspec.Struct, frozen=True):
    """A line of right ascension or declination, or a piece of one: its label and places, monitor
    px.
    """

    label: str
    px: list[list[float]]


class Truth(msgspec.Struct, frozen=True, kw_only=True):
    """What is where in a picture: stars, the brightest first, and the marks of the two cameras;
    monitor px.

    Of the tracker's newest answer: where it takes its field to be, and the centroids that it
    reports.
    """

    frame: int
    stars: list[StarMark]
    boresight_px: list[float] | UnsetType = UNSET
    tracker_px: list[list[float]] | UnsetType = UNSET
    grid: list[GridLine] | UnsetType = UNSET
    reported_px: list[list[float]] | UnsetType = UNSET
    centroids_px: list[list[float]] | UnsetType = UNSET


class PageText(msgspec.Struct, kw_only=True, omit_defaults=True):
    """A text message to a page: its keys say what it has."""

    hello: Hello | None = None
    state: PageState | None = None
    history: list[ChartPoint] | None = None
    point: ChartPoint | None = None
    event: EventLine | None = None
    answer: TrackerFigures | None = None
    truth: Truth | None = None

    def json(self) -> str:
        """The message as it is sent."""
        return msgspec.json.encode(self).decode()


class PictureFormat(msgspec.Struct, frozen=True, kw_only=True):
    """The head of a picture's binary message; `dtype` is u1 or u2."""

    w: int
    h: int
    frame: int
    dtype: str
    deflate: bool = True


class SkyPlace(msgspec.Struct, frozen=True, array_like=True):
    """A star or a body of the whole sky, as an array."""

    ra_deg: float
    dec_deg: float
    v_mag: float
    label: str


class SkyMap(msgspec.Struct, frozen=True):
    """The answer of `GET /sky`: stars, bodies, and the screen's corners as directions in cam ([]
    where the lens ends).
    """

    stars: list[SkyPlace] = []
    moving: list[SkyPlace] = []
    screen_cam: list[list[float]] = []


class PageWants(msgspec.Struct):
    """What a page wants besides the state."""

    picture: bool = False
    hz: Annotated[float, msgspec.Meta(gt=0)] = 8.0
    grid: bool = False

    @property
    def picture_hz(self) -> float:
        """How often it wants pictures, within bounds; 0 for never."""
        if self.picture:
            return min(max(self.hz, MIN_HZ), MAX_HZ)
        return 0.0


class PageMessage(msgspec.Struct):
    """A page's message."""

    want: PageWants


class OrderBody(msgspec.Struct, forbid_unknown_fields=True):
    """The body of `POST /control/NAME`. A key that is misspelt is refused: it must not act as if
    it were not there.
    """

    on: bool = True
    level: float = PATCH_SHARE
    text: str = ""
    name: str = ""
