"""The monitor behind its collimator as the camera that the tracker looks into, and the file of a
geometric calibration.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, shortened
from hilstar.basics.files import write_whole
from hilstar.basics.reading import named_text, parse_toml
from hilstar.basics.rotation import normalise, to_matrix
from hilstar.basics.toml_tables import toml_text
from hilstar.display.identity import TABLE, MonitorIdentity
from hilstar.optics.camera import Camera, Lens, ResidualField

MAX_FILE_BYTES = 1_000_000
MAX_TERMS = 21  # along each axis of [field]
NORM_TOLERANCE = 1e-3  # of q_cam_to_mon as it is written, which is then normalised
ADVICE = "give a file that `hilstar calibrate geometric` or `alignment` wrote"
Finite = Annotated[float, Meta(ge=-1e9, le=1e9)]
Sizes = tuple[Annotated[int, Meta(ge=1, le=32768)], Annotated[int, Meta(ge=1, le=32768)]]
KIND = "hilstar geometry 1"


class FieldTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """[field]: Chebyshev coefficients in px; entry [i][j] belongs to T_i of the column and T_j
    of the row.
    """

    x_px: list[list[Finite]]
    y_px: list[list[Finite]]


class LensTable(msgspec.Struct, frozen=True, kw_only=True):
    """Brown-Conrady coefficients of tangents of field angles, from direction to pixel."""

    k1: Finite = 0.0
    k2: Finite = 0.0
    k3: Finite = 0.0
    p1: Finite = 0.0
    p2: Finite = 0.0


class ErrorTable(msgspec.Struct, frozen=True, kw_only=True):
    """[error]: of dots that were held out, and one sigma of a star's place: over the screen (-1
    where unseen), rms and maximum.

    `modes_arcsec` times its transpose is the covariance of places: a mode has x and then y of the
    map, row by row. An alignment adds the rms of what its rotation leaves, one axis, and the
    covariance of the rotation about x, y and z with its freedom.
    """

    model: str = ""
    held_out_rms_arcsec: float | None = None
    held_out_max_arcsec: float | None = None
    noise_px: float | None = None
    rms_arcsec: float | None = None
    max_arcsec: float | None = None
    map_arcsec: list[list[float]] | None = None
    modes_arcsec: list[list[float]] | None = None
    alignment_cross_arcsec: float | None = None
    alignment_roll_arcsec: float | None = None
    alignment_covariance_arcsec2: list[list[float]] | None = None
    alignment_dof: float | None = None

    def __post_init__(self) -> None:
        modes = self.modes_arcsec
        turn = self.alignment_covariance_arcsec2
        places = 0
        if self.map_arcsec is not None:
            lengths = set(map(len, self.map_arcsec))
            if len(lengths) != 1:
                raise ValueError("map_arcsec has rows of different lengths")
            places = len(self.map_arcsec) * lengths.pop()
        if modes is not None and (not places or set(map(len, modes)) != {2 * places}):
            raise ValueError("modes_arcsec are not x and y of each place of map_arcsec")
        if turn is not None and list(map(len, turn)) != [3, 3, 3]:
            raise ValueError("alignment_covariance_arcsec2 is not 3 by 3")


class MadeTable(msgspec.Struct, frozen=True, kw_only=True):
    """[made]: by which version, when, and of how many poses of the tracker.

    Of an alignment also how many pairs were given and used, the lines of the wild ones, the
    rotation that was taken out, and where the lens is from.
    """

    by: str = ""
    when: str = ""
    poses: int | None = None
    pairs: int | None = None
    pairs_used: int | None = None
    wild_rows: list[int] | None = None
    rotation_arcsec: tuple[float, float, float] | None = None
    lens_of: str | None = None


@dataclass(frozen=True, slots=True)
class Notes:
    """Notes of a geometry file: one sigma of each parameter, how well it is known, how it was
    made, and on which monitor.
    """

    sigma: dict[str, float]
    error: ErrorTable
    made: MadeTable
    identity: MonitorIdentity | None = None


class GeometryFile(LensTable, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A whole file. `max_field_deg` is the angle from the axis to which it was calibrated, where
    that is less than the screen.

    `sigma`, `error` and `made` say how well it is known and how it was made; nothing is computed
    from them.
    """

    kind: str
    resolution_px: Sizes
    focal_length_px: Annotated[float, Meta(gt=0, le=1e9)]
    principal_point_px: tuple[Finite, Finite]
    q_cam_to_mon: tuple[Finite, Finite, Finite, Finite]
    tilt_deg: tuple[
        Annotated[float, Meta(gt=-60, lt=60)], Annotated[float, Meta(gt=-60, lt=60)]
    ] = (0.0, 0.0)
    max_field_deg: Annotated[float, Meta(gt=0, lt=90)] | None = None
    field: FieldTable | None = None
    sigma: dict[str, float] = {}
    error: ErrorTable | None = None
    made: MadeTable | None = None
    monitor_identity: MonitorIdentity | None = None


def load_geometry(path: Path, resolution_px: tuple[int, int]) -> Camera:
    """The camera of a geometry file for a monitor of `resolution_px`. Raises InputError."""
    geometry: GeometryFile = _read(path, GeometryFile, ADVICE)
    if geometry.kind != KIND:
        raise InputError(
            f"{path}: kind = {shortened(repr(geometry.kind))} and {KIND!r} is wanted; {ADVICE}"
        )
    if geometry.resolution_px != resolution_px:
        width, height = geometry.resolution_px
        bench_width, bench_height = resolution_px
        raise InputError(
            f"{path}: is of a monitor of {width} x {height} px and the bench file's monitor has"
            f" {bench_width} x {bench_height}; calibrate this monitor"
        )
    q = np.array(geometry.q_cam_to_mon)
    norm = float(np.linalg.norm(q))
    if not abs(norm - 1.0) <= NORM_TOLERANCE:
        raise InputError(f"{path}: q_cam_to_mon: its norm is {norm:.6g}; {ADVICE}")
    residual = None
    if geometry.field is not None:
        residual = _residual_field(path, geometry.field, resolution_px)
    tilt_x, tilt_y = np.radians(geometry.tilt_deg).tolist()
    max_tangent = math.inf
    if geometry.max_field_deg is not None:
        max_tangent = math.tan(math.radians(geometry.max_field_deg))
    lens = Lens(
        radial=(geometry.k1, geometry.k2, geometry.k3),
        tangential=(geometry.p1, geometry.p2),
        tilt_rad=(tilt_x, tilt_y),
        field=residual,
        max_tangent=max_tangent,
    )
    return Camera(
        resolution_px,
        geometry.focal_length_px,
        geometry.principal_point_px,
        to_matrix(normalise(q)),
        lens,
    )


def _residual_field(path: Path, field: FieldTable, resolution_px: tuple[int, int]) -> ResidualField:
    """What the lens leaves over the image, by a file's [field]. Raises InputError."""
    x_px = field.x_px
    y_px = field.y_px
    sides = {len(x_px), len(y_px), *map(len, x_px), *map(len, y_px)}
    if len(sides) != 1 or not 0 < len(x_px) <= MAX_TERMS:
        raise InputError(
            f"{path}: [field] has no two squares of one size, up to {MAX_TERMS}; {ADVICE}"
        )
    return ResidualField(np.array(x_px), np.array(y_px), resolution_px)


def load_notes(path: Path) -> Notes:
    """The notes of a geometry file. Raises InputError."""
    geometry: GeometryFile = _read(path, GeometryFile, ADVICE)
    return Notes(
        dict(geometry.sigma),
        geometry.error or ErrorTable(),
        geometry.made or MadeTable(),
        geometry.monitor_identity,
    )


def _read(path: Path, form: type[LensTable], advice: str) -> Any:
    """A file as a `form`. Raises InputError, which ends with `advice`."""
    return _parsed(path, named_text(path, advice, MAX_FILE_BYTES), form, advice)


# A session assembles its bench many times, and a file's [field] takes longer to parse than the rest
# of a bench to read.
@lru_cache(maxsize=8)
def _parsed(path: Path, text: str, form: type[LensTable], advice: str) -> Any:
    table = parse_toml(path, text)
    try:
        return msgspec.convert(table, form)
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {shortened(str(error))}; {advice}") from error


class DistortionFile(LensTable, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A tracker's flight model; `kind` may say so."""

    kind: str = ""


def load_distortion(path: Path, camera: Camera) -> Camera:
    """The camera of a tracker with the lens of its flight model. Raises InputError."""
    advice = "write k1, k2, k3, p1 and p2, numbers, as far as they are not 0"
    distortion: DistortionFile = _read(path, DistortionFile, advice)
    radial = distortion.k1, distortion.k2, distortion.k3
    tangential = distortion.p1, distortion.p2
    return replace(camera, lens=Lens(radial, tangential))


def write_geometry(path: Path, camera: Camera, q_cam_to_mon: FloatArray, notes: Notes) -> None:
    """Write a camera and its notes as a geometry file. Raises InputError where it cannot be
    written.
    """
    lens = camera.lens or Lens()
    field = None
    if lens.field is not None:
        field = FieldTable(x_px=lens.field.x.tolist(), y_px=lens.field.y.tolist())
    w, x, y, z = q_cam_to_mon.tolist()
    k1, k2, k3 = lens.radial
    p1, p2 = lens.tangential
    tilt_x, tilt_y = np.degrees(lens.tilt_rad).tolist()
    max_field_deg = None
    if math.isfinite(lens.max_tangent):
        max_field_deg = math.degrees(math.atan(lens.max_tangent))
    geometry = GeometryFile(
        kind=KIND,
        resolution_px=camera.resolution_px,
        focal_length_px=camera.focal_length_px,
        principal_point_px=camera.principal_point_px,
        q_cam_to_mon=(w, x, y, z),
        tilt_deg=(tilt_x, tilt_y),
        k1=k1,
        k2=k2,
        k3=k3,
        p1=p1,
        p2=p2,
        max_field_deg=max_field_deg,
        field=field,
        sigma=notes.sigma,
        error=notes.error,
        made=notes.made,
    )
    table = msgspec.to_builtins(geometry)
    if notes.identity is not None:
        table[TABLE] = notes.identity.known()
    write_whole(path, toml_text(table))


def monitor_camera(
    resolution_px: tuple[int, int],
    pixel_pitch_um: float,
    focal_length_mm: float,
    q_cam_to_mon: FloatArray,
    principal_point_px: tuple[float, float] | None = None,
) -> Camera:
    """The camera that maps cam directions to monitor pixels.

    `mon` has the axes of cam (x right, y down, as the tracker sees it); `q_cam_to_mon` is the
    alignment of the
    tracker on the bench. The collimator's axis meets the monitor at `principal_point_px`, by
    default its middle.
    """
    width, height = resolution_px
    middle = ((width - 1) / 2, (height - 1) / 2)
    return Camera(
        resolution_px=resolution_px,
        focal_length_px=focal_length_mm * 1000.0 / pixel_pitch_um,
        principal_point_px=principal_point_px or middle,
        cam_to_image=to_matrix(normalise(np.asarray(q_cam_to_mon, dtype=np.float64))),
    )
