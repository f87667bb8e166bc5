"""What the benchmark measures, as the JSON object of the command holds it."""

from __future__ import annotations

from dataclasses import dataclass, field

from msgspec import UNSET, UnsetType

Size = tuple[int, int]
REFERENCE_PX: Size = (1920, 1080)


@dataclass(frozen=True, slots=True)
class Spread:
    """Times of a work, ms."""

    median: float
    min: float
    max: float


@dataclass(frozen=True, slots=True)
class Cell:
    """An image size, px, and a number of stars in view."""

    width: int
    height: int
    stars: int

    @property
    def size(self) -> Size:
        """Width and height, px."""
        return self.width, self.height


@dataclass(frozen=True, slots=True)
class Timing(Cell):
    """How long a method takes in a cell; `kind` is the whole frame, the linear image alone or a stage of hilstar's."""

    method: str
    kind: str
    ms: Spread


@dataclass(frozen=True, slots=True)
class PythonTime(Cell):
    """How long all of a frame takes that is not OpenGL."""

    ms: Spread


@dataclass(frozen=True, slots=True)
class SceneOrigin(Cell):
    """How many of a cell's stars are the catalogue's, and how many are random."""

    catalogue: int
    random: int


@dataclass(frozen=True, slots=True)
class Agreement(Cell):
    """The largest difference of a method's linear image from hilstar's, as a share of hilstar's brightest pixel."""

    method: str
    worst_of_peak: float


@dataclass(frozen=True, slots=True)
class Skipped:
    """A method that was not measured, in one cell or in any, and why."""

    width: int | UnsetType = UNSET
    height: int | UnsetType = UNSET
    stars: int | UnsetType = UNSET
    method: str = ""
    why: str = ""


@dataclass(frozen=True, slots=True)
class Start:
    """Times of import and first frame in a process of its own, and its peak memory."""

    width: int
    height: int
    import_ms: float
    first_frame_ms: float
    memory_mb: float

    @property
    def size(self) -> Size:
        """Width and height, px."""
        return self.width, self.height


@dataclass(frozen=True, slots=True)
class Aim:
    """A time that the project set itself, and whether this run reached it; None on a busy machine."""

    what: str
    aim_ms: float
    measured_ms: float
    reached: bool | None


@dataclass(frozen=True, slots=True)
class Machine:
    """Where the times were taken; `load` is the average of the last minute before, which is in the times too."""

    cpu: str
    cores: int
    load: float
    python: str
    numpy: str


@dataclass(slots=True)
class Result:
    """The JSON object of `hilstar benchmark`; it grows while the benchmark runs."""

    machine: Machine
    gl_renderer: str = ""
    rows: list[Timing] = field(default_factory=list)
    scenes: list[SceneOrigin] = field(default_factory=list)
    agreement: list[Agreement] = field(default_factory=list)
    startup: list[Start] = field(default_factory=list)
    python_ms: list[PythonTime] = field(default_factory=list)
    does: dict[str, str] = field(default_factory=dict)
    skipped: list[Skipped] = field(default_factory=list)
    import_ms: float = 0.0
    first_frame_ms: float = 0.0
    memory_mb: float = 0.0
    aims: list[Aim] = field(default_factory=list)
    others_cores: float = 0.0  # that other processes took while it ran
