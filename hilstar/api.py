"""The Python API: a bench that is opened, what is done with it, and its frames.

It stands above the server and the instruments, which do the work, and below the commands.
"""

from __future__ import annotations  # docs/python-api.md shows annotations as they are written

import base64
import html
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import Float32Array, FloatArray
from hilstar.basics.attitudes import (
    is_place,
    path_of,
    quaternion_of,
    rate_of,
    seconds_of,
    t_ns_of,
    whole_of,
)
from hilstar.basics.errors import InputError, shortened
from hilstar.basics.rotation import to_radec_roll_deg
from hilstar.optics.layers.truth import clipped_in
from hilstar.server.bench.bench_file import BenchFile, file_of_tables, read_bench_file
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.cameras import FieldsOfView, fields_of_view
from hilstar.server.bench.config import BenchConfig
from hilstar.server.bench.drawn import Drawn
from hilstar.server.bench.frame import Bench, Frame, checked_quaternion
from hilstar.server.bench.frame_files import (
    preview_png,
    sky_header,
    write_codes_png,
    write_frame_fits,
    write_truth_csv,
)

if TYPE_CHECKING:
    from astropy.table import QTable
    from astropy.units import Quantity
    from astropy.wcs import WCS

    from hilstar.basics.attitudes import Angle, Attitude, Rate, Time
    from hilstar.instruments.assess.assessment import Assessment
    from hilstar.instruments.simulate.budget import By, LightBudget
    from hilstar.instruments.simulate.simulator import Exposure, Simulator
    from hilstar.instruments.verify.verdict import Verdict
    from hilstar.optics.layers.faults import FaultLayer

# The unit of a column of the truth by the end of its name; the longest end comes first.
COLUMN_UNITS = {
    "electrons_per_s": "electron / s",
    "electrons_r_per_s": "electron / s",
    "electrons_g_per_s": "electron / s",
    "electrons_b_per_s": "electron / s",
    "bv": "mag",
    "_arcsec": "arcsec",
    "_mag": "mag",
    "_mas": "mas",
    "_deg": "deg",
    "_px": "pix",
    "_d": "day",
    "_k": "K",
}
ROUNDING = 1e-6  # of a unit quaternion that is written with seven digits
MAX_FIELDS = 100_000
FAULTS_FORM = (
    "write a layer of faults, or leave it out; `hilstar frame --scenario FILE.toml` draws a file's"
)
PICTURE_PX = 640  # width of a picture in a notebook
# A bench without a file: what messages call it, in the current folder.
FROM_TABLES, FROM_CONFIG = Path("dictionary"), Path("configuration")


def load(bench: str | Path | Mapping[str, Any] | BenchConfig) -> OpenBench:
    """Open a bench: a bench file, its tables as a dictionary, or a configuration that was read.

    Paths within a dictionary or a configuration are relative to the current folder. NumPy draws
    where OpenGL is missing. Raises InputError.

    >>> bench = hilstar.load("bench.toml")
    >>> bench.close()
    """
    file = _bench_file(bench)
    opened = open_bench(file)
    return OpenBench(**{part.name: getattr(opened, part.name) for part in fields(opened)})


def _bench_file(bench: object) -> BenchFile:
    if isinstance(bench, (str, Path)):
        return read_bench_file(Path(bench))
    if isinstance(bench, Mapping):
        return file_of_tables(FROM_TABLES, bench)
    if isinstance(bench, BenchConfig):
        return file_of_tables(FROM_CONFIG, bench)
    raise InputError(
        f"load {shortened(repr(bench))}: give the path of a bench file, its tables as a"
        " dictionary, or a BenchConfig"
    )


@dataclass(frozen=True, eq=False, repr=False)
class SkyFrame(Frame):
    """A frame of a bench: its light, the codes that ask for it, the stars behind it, and the bench
    that it is of.

    `linear` is float32 (height, width), electrons per second, and `np.asarray(frame)` the same
    array; `light` has its channels (channels, height, width). `codes` are the code values that the
    monitor is given. `truth` is a structured array with a row for each star in view, the brightest
    first. `q_icrs_to_cam` is the attitude and `t_ns` the moment for which bodies were placed. A
    pickled frame has all of these, but no bench.

    >>> with hilstar.load("bench.toml") as bench:
    ...     frame = bench.frame([0.6987226, 0.7135120, -0.0370377, 0.0362700])
    >>> np.asarray(frame).shape
    (1080, 1920)
    """

    bench: Bench | None = None

    @property
    def _bench(self) -> Bench:
        if self.bench is None:
            raise InputError(
                "frame: has no bench, as one that was pickled; take it of"
                " hilstar.load(...).frame(...)"
            )
        return self.bench

    def __getstate__(self) -> dict[str, Any]:
        return super().__getstate__() | {"bench": None}

    def __array__(
        self, dtype: npt.DTypeLike | None = None, copy: bool | None = None
    ) -> npt.NDArray[Any]:
        linear: Float32Array = self.linear
        wanted = linear.dtype if dtype is None else np.dtype(dtype)
        if wanted != linear.dtype and copy is False:
            raise ValueError(f"a float32 image as {wanted} is a copy")
        return linear.astype(wanted, copy=bool(copy))

    def to_table(self) -> QTable:
        """The truth as an Astropy QTable with units: the columns of truth.csv, brightest first.

        `ra_deg` and `dec_deg` are the apparent place, ICRS axes; bodies have names.

        >>> table = frame.to_table()
        >>> print(table["hip"][0], table["ra_deg"].unit, table["electrons_per_s"].unit)
        26311 deg electron / s
        """
        from astropy.table import QTable

        truth = self.truth
        names = truth.dtype.names or ()
        units = {name: unit for name in names if (unit := _unit_of(name)) is not None}
        return QTable(
            [truth[name] for name in names],
            names=names,
            units=units,
            meta={"bench_sha256": self._bench.file.sha256},
        )

    @property
    def wcs(self) -> WCS:
        """The image's world coordinate system, an Astropy WCS of ICRS; pixel (0, 0) is the centre
        of the first.

        Behind a lens it has SIP terms, as the FITS of `save` has.

        >>> x_px, y_px = frame.wcs.world_to_pixel_values(84.057, -1.2)
        >>> print(f"{x_px:.1f} {y_px:.1f}")
        959.5 539.5
        """
        from astropy.wcs import WCS

        bench = self._bench
        header = sky_header(
            bench.file.sha256, bench.config.sky.epoch_jyear, self.q_icrs_to_cam, bench.camera
        )
        height, width = self.linear.shape
        header["NAXIS"], header["NAXIS1"], header["NAXIS2"] = 2, width, height
        return WCS(header)

    def save(self, path: str | Path) -> Path:
        """Write the frame to a file, by its ending: .fits or .fits.gz the linear image, .csv the
        truth, .png the code values.

        The files are those of `hilstar frame`. Raises InputError for another ending.

        >>> print(frame.save("golden.fits"))
        golden.fits
        """
        target, bench = path_of(path, "save"), self._bench
        if target.name.endswith((".fits", ".fits.gz")):
            write_frame_fits(target, bench, self)
        elif target.suffix == ".csv":
            write_truth_csv(target, self)
        elif target.suffix == ".png":
            write_codes_png(target, self.codes, bench.config.monitor.bits)
        else:
            raise InputError(
                f"{target}: write .fits for the linear image, .csv for the truth, or .png for the"
                " code values"
            )
        return target

    def __repr__(self) -> str:
        height, width = self.linear.shape
        return (
            f"<hilstar frame at {_place_text(self.q_icrs_to_cam)}: {len(self.rows)} stars,"
            f" {self.linear.sum(dtype=np.float64):.4g} e/s, {width} x {height} px>"
        )

    def _repr_html_(self) -> str:
        picture = base64.b64encode(preview_png(self.levels)).decode("ascii")
        clipped = clipped_in(self.rows)
        figures = {
            "RA, Dec, roll": _place_text(self.q_icrs_to_cam),
            "stars": f"{len(self.rows)}, {int(self.rows['drawn'].sum())} of them drawn",
            "brightest": _brightest_text(self.rows),
            "light": f"{self.linear.sum(dtype=np.float64):.4g} electrons/s",
            "clipped": ", ".join(map(str, clipped)) or "none",
        }
        image = f'<img width="{PICTURE_PX}" alt="the frame, stretched" src="data:image/png;base64,'
        return f'{image}{picture}">{_figures_html(figures)}'


def _check_faults(faults: object) -> None:
    """Raise InputError for what is no layer of faults."""
    from hilstar.optics.layers.faults import FaultLayer

    if faults is not None and not isinstance(faults, FaultLayer):
        raise InputError(f"faults {shortened(repr(faults))}: {FAULTS_FORM}")


def _check_roll(attitude: object, roll_deg: object, number: object, name: str) -> None:
    """Raise InputError for a frame's number beside a place without roll: it may be meant as one."""
    is_first = isinstance(number, (int, np.integer)) and number == 0
    if is_place(attitude) and roll_deg is None and not is_first:
        raise InputError(
            f"{name} {shortened(repr(number))} beside a SkyCoord: write the roll as roll_deg=...,"
            " 0 too"
        )


def _unit_quaternion(q_icrs_to_cam: FloatArray) -> FloatArray:
    """A quaternion as it was given where its norm is 1, as its last bits choose between codes that
    are as good; else normalised. Raises InputError as `checked_quaternion`.
    """
    unit = checked_quaternion(q_icrs_to_cam)
    if np.abs(unit - q_icrs_to_cam).max() < ROUNDING:
        return q_icrs_to_cam
    return unit


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class OpenBench(Bench):
    """A bench, open: it draws frames, simulates its tracker, and is verified. Free it with `close`,
    or use it in a `with` statement.

    `config` is its configuration, with everything chosen that the file left open. `stars` is the
    sky, `camera` the geometry, `calibration` the monitor's. An attitude is a unit quaternion
    q_icrs_to_cam (w, x, y, z), a SciPy Rotation that turns ICRS components into camera components,
    or an Astropy SkyCoord with `roll_deg`. Rates are rad/s, `t_ns` nanoseconds and `roll_deg`
    degrees, or Astropy quantities.

    >>> with hilstar.load("bench.toml") as bench:
    ...     print(bench)
    <hilstar bench bench.toml: 1920 x 1080 px, screen 18.0 x 10.2 deg, 25688 stars>
    """

    def frame(
        self,
        q_icrs_to_cam: Attitude,
        number: int = 0,
        t_ns: Time | None = None,
        faults: FaultLayer | None = None,
        *,
        roll_deg: Angle | None = None,
    ) -> SkyFrame:
        """Draw one frame and read all of it back; the arrays are copies.

        Stars too faint for the monitor are in the linear image and the truth, and not drawn.
        `number` counts frames; with `temporal` this is the first frame of a sequence. Bodies are
        where they are at `t_ns`. Raises InputError for a quaternion that is not unit within 1e-3.

        >>> from astropy.coordinates import SkyCoord
        >>> with hilstar.load("bench.toml") as bench:
        ...     frame = bench.frame(SkyCoord("05h36m13.68s -1d12m0s"), roll_deg=0)
        >>> frame
        <hilstar frame at RA 84.057, Dec -1.200, roll 0.000 deg: 218 stars, ...>
        """
        self._refuse_closed("frame")
        _check_faults(faults)
        _check_roll(q_icrs_to_cam, roll_deg, number, "number")
        drawn = super().frame(
            quaternion_of(q_icrs_to_cam, roll_deg),
            whole_of(number, "number"),
            None if t_ns is None else t_ns_of(t_ns),
            faults,
        )
        return SkyFrame(
            **{each.name: getattr(drawn, each.name) for each in fields(drawn)}, bench=self
        )

    def draw(
        self,
        q_icrs_to_cam: Attitude | None,
        frame: int = 0,
        rate_cam_rad_s: Rate | None = None,
        t_ns: Time | None = None,
        *,
        roll_deg: Angle | None = None,
    ) -> Drawn:
        """Draw the levels for an attitude, as `hilstar serve` does for each frame; None is a blank
        frame. The fast path: no copy, no table.

        With a rate that moves stars by more than `[render] motion_above_px`, each star is drawn
        along its path while its row is lit. `frame` counts the frames shown.

        >>> with hilstar.load("bench.toml") as bench:
        ...     print(bench.draw([0.6987226, 0.7135120, -0.0370377, 0.0362700]).levels.shape)
        (1080, 1920)
        """
        self._refuse_closed("draw")
        if q_icrs_to_cam is None and roll_deg is not None:
            raise InputError("draw: a blank frame has no roll; leave roll_deg out")
        _check_roll(q_icrs_to_cam, roll_deg, frame, "frame")
        q = None
        if q_icrs_to_cam is not None:
            q = _unit_quaternion(quaternion_of(q_icrs_to_cam, roll_deg))
        return super().draw(
            q,
            whole_of(frame, "frame"),
            None if rate_cam_rad_s is None else rate_of(rate_cam_rad_s),
            None if t_ns is None else t_ns_of(t_ns),
        )

    def simulate(
        self,
        q_icrs_to_cam: Attitude,
        rate_cam_rad_s: Rate | None = None,
        t_ns: Time | None = None,
        *,
        roll_deg: Angle | None = None,
        seed: int = 0,
        noise: Literal["full", "none"] = "full",
    ) -> Exposure:
        """An exposure of the virtual tracker, which looks at the sky itself: `dn` uint16 (height,
        width), `mean_e` the electrons expected, `truth` its stars.

        The attitude is that in the middle of the exposure. The same `seed` gives the same noise.
        The sky is that of the bench file. Raises InputError.

        >>> with hilstar.load("bench.toml") as bench:
        ...     exposure = bench.simulate([0.6987226, 0.7135120, -0.0370377, 0.0362700])
        >>> exposure.dn.shape
        (1024, 1024)
        """
        from hilstar.instruments.simulate.simulator import FrameNoise

        self._refuse_closed("simulate")
        if noise not in {"full", "none"}:
            raise InputError(f"noise {shortened(repr(noise))}: write full or none")
        q = checked_quaternion(quaternion_of(q_icrs_to_cam, roll_deg))
        rate = np.zeros(3) if rate_cam_rad_s is None else rate_of(rate_cam_rad_s)
        simulator = self._simulator
        view = simulator.view(q, rate, None if t_ns is None else t_ns_of(t_ns))
        return simulator.expose(view, FrameNoise(noise, whole_of(seed, "seed")).rng())

    @cached_property
    def _simulator(self) -> Simulator:
        from hilstar.instruments.simulate.simulator import Simulator

        return Simulator(self.file)

    def verify(self, fields: int = 10, seed: int = 0) -> Verdict:
        """Run the digital twin: what the tracker would measure of the stars shown, against the sky,
        at `fields` attitudes by chance.

        The verdict has `passed`, `reasons`, `errors` and `measured`. Raises InputError.

        >>> with hilstar.load("bench.toml") as bench:
        ...     verdict = bench.verify(fields=1)
        >>> verdict.passed
        True
        """
        from hilstar.instruments.verify.summary import verify

        generator = np.random.default_rng(whole_of(seed, "seed"))
        return verify(self.file, whole_of(fields, "fields", 1, MAX_FIELDS), generator)

    def budget(self, centroider: By | None = None) -> LightBudget:
        """Which magnitudes this monitor, sprite and quantisation can show, and how accurately, by
        a row a magnitude.

        `centroider` says who finds the stars, as `hilstar budget --centroider`. Raises InputError.

        >>> with hilstar.load("bench.toml") as bench:
        ...     budget = bench.budget()
        >>> print(f"{budget.range_mag:.1f} mag")
        11.3 mag
        """
        from hilstar.instruments.simulate.budget import budget
        from hilstar.tracker.centroiders import FAMILY

        self._refuse_closed("budget")
        choices = (*FAMILY, "all")
        if centroider is not None and centroider not in choices:
            raise InputError(
                f"centroider {shortened(repr(centroider))}: write one of {', '.join(choices)}"
            )
        return budget(self, centroider)

    def close(self) -> None:
        """Free the GL contexts of the bench and of its virtual tracker."""
        simulator = self.__dict__.pop("_simulator", None)
        if simulator is not None:
            simulator.close()
        self.__dict__["_closed"] = True
        super().close()

    def _refuse_closed(self, what: str) -> None:
        if self.__dict__.get("_closed"):
            raise InputError(f"{what}: the bench is closed; open it again with hilstar.load")

    @cached_property
    def _fields_of_view(self) -> FieldsOfView:
        return fields_of_view(self.config, self.file.folder)

    def __repr__(self) -> str:
        width, height = self.config.monitor.resolution_px
        screen = " x ".join(f"{side:.1f}" for side in self._fields_of_view.screen_deg)
        return (
            f"<hilstar bench {self.file.path.name}: {width} x {height} px, screen {screen} deg,"
            f" {len(self.stars)} stars>"
        )

    def _repr_html_(self) -> str:
        view = self._fields_of_view
        width, height = self.config.monitor.resolution_px
        figures = {
            "monitor": f"{width} x {height} px, {self.config.monitor.bits} bit",
            "fields of view": view.line(),
            "stars": f"{len(self.stars)}, {len(self.shown_stars)} of them bright enough to show",
            "white": f"{self.flux_at_white_e_per_s:.4g} electrons/s in a pixel",
            "drawn by": self.renderer.gl_renderer,
        }
        return f"{_fields_svg(view)}{_figures_html(figures)}"


def assess(
    ledger: str | Path,
    telemetry: str | Path | None = None,
    *,
    stamp: Literal["start", "middle", "end"] | None = None,
    latency_s: float | Quantity = 0.0,
    display_attitudes: int = 12,
) -> Assessment:
    """A tracker's error budget, of a run's ledger and the tracker's answers: in `telemetry`, or in
    the ledger.

    `stamp` says where in an exposure the times stand, `latency_s` how much later than that, a
    number of seconds or an Astropy quantity. At `display_attitudes` attitudes the twin measures
    what the display adds. Raises InputError for a fault of either file.

    >>> found = hilstar.assess("run.mcap", "telemetry.csv", display_attitudes=0)
    """
    from hilstar.instruments.assess.assessment import AssessSettings, assess_files

    if stamp not in {None, "start", "middle", "end"}:
        raise InputError(f"stamp {shortened(repr(stamp))}: write start, middle or end")
    settings = AssessSettings(
        stamp, seconds_of(latency_s, "latency_s"), whole_of(display_attitudes, "display_attitudes")
    )
    return assess_files(
        path_of(ledger, "ledger"),
        None if telemetry is None else path_of(telemetry, "telemetry"),
        settings,
    )


def _unit_of(column: str) -> str | None:
    """The unit of a column of the truth; None for one that has none."""
    return next((unit for end, unit in COLUMN_UNITS.items() if column.endswith(end)), None)


def _place_text(q_icrs_to_cam: FloatArray) -> str:
    ra_deg, dec_deg, roll_deg = to_radec_roll_deg(q_icrs_to_cam)
    # an angle that rounds to a full turn is 0
    ra, roll = (round(angle, 3) % 360.0 for angle in (ra_deg, roll_deg))
    return f"RA {ra:.3f}, Dec {dec_deg:.3f}, roll {roll:.3f} deg"


def _brightest_text(rows: npt.NDArray[np.void]) -> str:
    if not len(rows):
        return "none"
    name = rows[0]["name"] or f"HIP {rows[0]['hip']}"
    return f"{name}, V {rows[0]['v_mag']:.2f}"


def _figures_html(figures: Mapping[str, str]) -> str:
    lines = (
        f"<tr><th>{html.escape(name)}</th><td>{html.escape(text)}</td></tr>"
        for name, text in figures.items()
    )
    return f"<table>{''.join(lines)}</table>"


def _fields_svg(view: FieldsOfView) -> str:
    """The outlines of the screen's field and the tracker's, to one scale."""
    sides = (view.screen_deg, view.tracker_deg)
    width = max(each[0] for each in sides)
    height = max(each[1] for each in sides)
    stroke = width / 200
    outlines = ""
    for name, (across, down) in zip(("screen", "tracker"), sides, strict=True):
        dash = f' stroke-dasharray="{4 * stroke:g}"' if name == "tracker" else ""
        outlines += (
            f'<rect x="{-across / 2:g}" y="{-down / 2:g}" width="{across:g}" height="{down:g}"'
            f' fill="none" stroke="currentColor" stroke-width="{stroke:g}"{dash}>'
            f"<title>{name}, {across:.1f} x {down:.1f} deg</title></rect>"
        )
    box = f"{-width / 2 - stroke:g} {-height / 2 - stroke:g} {width + 2 * stroke:g}"
    return (
        f'<svg role="img" aria-label="fields of the screen and, dashed, the tracker"'
        f' width="{PICTURE_PX // 2}" viewBox="{box} {height + 2 * stroke:g}">{outlines}</svg>'
    )
