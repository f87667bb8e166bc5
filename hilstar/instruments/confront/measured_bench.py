"""The bench file that photographs give of a tracker, and the files that it names; and such a
file read back.
"""

import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.files import write_whole
from hilstar.basics.reading import MAX_TOML_BYTES, parse_toml, read_text
from hilstar.basics.units import flux_ratio
from hilstar.instruments.confront.background import FixedPattern
from hilstar.instruments.confront.light import NO_CORRECTION, LightFit
from hilstar.instruments.confront.photon_transfer import PixelFit
from hilstar.instruments.confront.session import FixedCamera, Session, corrected, radius2_of
from hilstar.instruments.confront.star_psf import (
    HALF,
    MEAN_BV_MAG,
    Stamps,
    StarPsf,
    fit_psf,
)
from hilstar.optics.camera import Lens
from hilstar.optics.glass.psf_file import Stack, facts_of, glass_of, write_glass
from hilstar.optics.psf import GaussianPsf, read_psf
from hilstar.server.bench.bench_file import BenchFile, bench_file_of
from hilstar.server.bench.cameras import tracker_camera, tracker_psf
from hilstar.server.bench.glass import glass_in
from hilstar.server.bench.star_rates import bench_optics
from hilstar.sky.spectrum import Curve

GRID = 4  # field points along each side of the PSF file
PER_PX, HALF_PX = 4, 6  # samples a pixel, and half of a PSF image's side
MODEL = "confront: "  # before the PSF's own numbers in the file's history
CARD_CHARACTERS = 60  # of them in a line of that history
# a 24 inch screen, for a bench whose file has no monitor
SCREEN_PX, SCREEN_PITCH_UM, FILLED = (1920, 1080), 265.5, 0.95
PLACEHOLDER = (
    "[monitor]\nresolution_px = [1920, 1080]\npixel_pitch_um = 265.5\n[collimator]\nfocal_length_mm"
    " = 1000.0\n"
)
UNDATED = '[sky]\nepoch_utc = "2000-01-01T00:00:00Z"\n'
NAMES = ("tracker.toml", "tracker_distortion.toml", "tracker_qe.csv", "tracker_psf.fits")
COPIED_TABLES = ("render", "attitude", "verify", "sync")  # of the given file, as they are
PATH_KEYS = {
    "calibration",
    "geometry",
    "catalogue",
    "file",
    "map",
    "transmission",
    "orbit",
    "satellites",
    "satellite_magnitudes",
    "extinction",
    "true_calibration",
    "true_geometry",
}


def read_tracker_file(path: Path) -> tuple[BenchFile, bool]:
    """A bench file, or one that has [tracker] alone, and whether it has a monitor. Raises
    InputError.
    """
    text = read_text(
        path, "give the path of a bench file, or of one that has [tracker] alone", MAX_TOML_BYTES
    )
    tables = parse_toml(path, text)
    has_screen = "monitor" in tables or "collimator" in tables
    if "site" in tables and "sky" not in tables:
        text = f"{text.rstrip()}\n{UNDATED}"  # photographs have dates of their own
    if not has_screen:
        text = f"{text.rstrip()}\n{PLACEHOLDER}"
    return bench_file_of(path, text), has_screen


def write_tracker(folder: Path, session: Session, has_screen: bool) -> Path:
    """Write the camera of a session as a bench file and the files it names. Raises InputError
    where they cannot be written.
    """
    _write_distortion(folder / NAMES[1], session)
    exposure = _write_efficiency(folder / NAMES[2], session)
    _write_psf(folder / NAMES[3], session)
    tables = _tables(session, exposure.exposure_s, has_screen)
    absolute = _absolute(tables, session.file.folder)
    comments = [f"# {note}\n" for note in _notes(session, exposure.factor, has_screen)]
    lines = "\n".join(_toml(absolute))
    path = folder / NAMES[0]
    write_whole(path, f"{''.join(comments)}{lines}\n")
    return path


def _write_distortion(path: Path, session: Session) -> None:
    lens = session.camera.camera.lens or Lens()
    k1, k2, _ = lens.radial
    p1, p2 = lens.tangential
    lines = [f"# fitted to {len(session.shots)} photographs: {session.camera.model}"]
    for name, value in (("k1", k1), ("k2", k2), ("p1", p1), ("p2", p2)):
        line = f"{name} = {value:.9g}"
        sigma = session.camera.sigma.get(name)
        if sigma is not None:
            line += f"  # +- {sigma:.2g}"
        lines.append(line)
    write_whole(path, "\n".join(lines) + "\n")


def _tables(session: Session, exposure_s: float, has_screen: bool) -> dict[str, Any]:
    """The tables of the bench file: the fitted tracker, its sky and background, and the others as
    they were given.
    """
    pixels = session.pixels
    given = parse_toml(session.file.path, session.file.text)
    tables: dict[str, Any] = {"tracker": _tracker(session, given["tracker"], exposure_s)}
    if session.air is not None and session.shots[0].photo.t_ns is not None:
        # the sky's own light is in [background], as it was measured
        site = given.get("site", {})
        tables["site"] = {key: site[key] for key in site if not key.startswith("sky_")}
    tables["sky"] = _dated_sky(session, given)
    levels_dn = [np.median(shot.level.level) for shot in session.shots]
    light_dn = float(np.median(levels_dn)) - pixels.pedestal_dn
    light_e = max(light_dn * pixels.gain_e_per_dn, 0.0)
    tables["background"] = {"electrons_per_px": light_e}
    if has_screen:
        tables["monitor"] = dict(given.get("monitor", {}))
        tables["collimator"] = dict(given.get("collimator", {}))
    else:
        tables["monitor"] = {"resolution_px": list(SCREEN_PX), "pixel_pitch_um": SCREEN_PITCH_UM}
        tables["collimator"] = {"focal_length_mm": round(_collimator_mm(session), 1)}
    for name, table in given.items():
        if name in COPIED_TABLES:
            tables[name] = table
    return tables


def _tracker(session: Session, given: dict[str, Any], exposure_s: float) -> dict[str, Any]:
    """The keys of [tracker]."""
    camera = session.camera.camera
    tracker = session.file.config.tracker
    # twice that of a mosaic's plane
    pitch_um = tracker.pixel_pitch_um * tracker.resolution_px[0] / camera.resolution_px[0]
    principal_point_px = [round(place_px, 4) for place_px in camera.principal_point_px]
    table: dict[str, Any] = {
        "aperture_mm": tracker.aperture_mm,
        "focal_length_mm": camera.focal_length_px * pitch_um * 1e-3,
        "pixel_pitch_um": pitch_um,
        "resolution_px": list(camera.resolution_px),
        "principal_point_px": principal_point_px,
        "quantum_efficiency": NAMES[2],
        "transmission": tracker.transmission,
        "exposure_s": exposure_s,
        "distortion": NAMES[1],
    }
    if tracker.frame_hz is not None:
        # the photographs' exposure may be longer than the period that was given
        table["frame_hz"] = min(tracker.frame_hz, 1 / exposure_s)
    table["optics"] = {"psf": NAMES[3]}
    table["detector"] = _detector(session, given.get("detector", {}))
    return table


def _collimator_mm(session: Session) -> float:
    """The focal length at which the tracker's field fills the example's screen, mm."""
    camera = session.camera.camera
    lengths_mm = []
    for screen_px, tracker_px in zip(SCREEN_PX, camera.resolution_px, strict=True):
        half_screen_mm = screen_px * SCREEN_PITCH_UM * 1e-3 / 2
        tangent = tracker_px / 2 / camera.focal_length_px
        lengths_mm.append(half_screen_mm / tangent)
    return FILLED * min(lengths_mm)


def _notes(session: Session, factor: float, has_screen: bool) -> Iterator[str]:
    """Comments at the head of the bench file; `factor` is how much longer its exposure is than the
    one that was given.
    """
    names = ", ".join(shot.photo.name for shot in session.shots)
    yield f"By hilstar confront from {names}."
    if factor > 1:
        yield (
            "Aperture and exposure are those that were given, but more light came than they give:"
            f" exposure_s is {factor:.3g} times it."
        )
    else:
        yield "Aperture and exposure are those that were given."
    yield f"The gain: {session.pixels.gain_words}."
    if not has_screen:
        yield "The monitor and the collimator are examples that fill the field: write your own."
    if session.power != 1:
        yield f"DN are those of the file, made linear: to the power {1 / session.power:.4f}."


def _dated_sky(session: Session, given: dict[str, Any]) -> dict[str, Any]:
    """The keys of [sky], those that were given, at the time of the first photograph.

    Air and bodies need a date: the photograph's, else the one that was given.
    """
    sky = dict(given.get("sky", {}))
    given_utc = sky.pop("epoch_utc", None)
    for key in ("epoch_jyear", "observer_velocity_km_s"):
        sky.pop(key, None)
    first_ns = session.shots[0].photo.t_ns
    dated = session.shots[0].sky
    bodies = bool(sky.get("bodies"))
    if first_ns is not None and (session.air is not None or bodies):
        sky["epoch_utc"] = f"{np.datetime64(first_ns, 'ns').astype('datetime64[ms]')}Z"
    elif bodies and given_utc is not None:
        sky["epoch_utc"] = given_utc
    else:
        sky["epoch_jyear"] = round(dated.epoch_jyear, 6)
    if session.air is None and dated.velocity_km_s is not None and not bodies:
        sky["observer_velocity_km_s"] = [round(float(v), 4) for v in dated.velocity_km_s]
    sky.setdefault("faintest_v_mag", 10.0)
    return sky


def _detector(session: Session, given: dict[str, Any]) -> dict[str, Any]:
    """The keys of [tracker.detector]; a gain that neither photographs nor the `given` keys tell
    is none of them.
    """
    pixels = session.pixels
    full_dn = session.shots[0].photo.full_dn
    gain = pixels.gain_e_per_dn
    full_e = (full_dn - pixels.pedestal_dn) * gain
    # a file's levels may be steps of several DN, whose rounding is noise to a detector of steps of
    # one
    rounding_e = math.sqrt(max(pixels.step_dn**2 - 1, 0) / 12) * gain
    bits = math.ceil(math.log2(full_dn + 1))
    detector: dict[str, Any] = {
        "gain_e_per_dn": gain,
        "full_well_e": max(full_e, 1.0),
        "bits": int(np.clip(bits, 1, 16)),
        "offset_dn": max(pixels.pedestal_dn, 0.0),
        "read_noise_e": math.hypot(pixels.read_noise_e, rounding_e),
    }
    if not pixels.gain_told and "gain_e_per_dn" not in given:
        del detector["gain_e_per_dn"]
    response, offsets_dn, *_ = pixels.pattern.rms
    if response:
        detector["prnu"] = response
    if offsets_dn:
        detector["dsnu_e"] = offsets_dn * gain
    return detector


def _absolute(tables: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Tables whose paths of files that exist are absolute: the new file may lie elsewhere."""
    absolute: dict[str, Any] = {}
    for key, value in tables.items():
        if isinstance(value, dict):
            absolute[key] = _absolute(value, folder)
        elif key in PATH_KEYS and isinstance(value, str) and (folder / value).is_file():
            absolute[key] = str((folder / value).resolve())
        else:
            absolute[key] = value
    return absolute


def _toml(table: dict[str, Any], name: str = "") -> Iterator[str]:
    """Lines of a table and those in it; JSON and TOML write numbers, truth values, lists and
    plain text alike.
    """
    if name:
        yield f"\n[{name}]"
    for key, value in table.items():
        if not isinstance(value, dict):
            yield f"{key} = {json.dumps(value)}"
    # a key after a table's head would be that table's: tables last
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _toml(value, f"{name}.{key}" if name else key)


@dataclass(frozen=True, slots=True)
class _Exposure:
    """The exposure of the bench file, and how many times it is that of the photographs."""

    exposure_s: float
    factor: float


def _write_efficiency(path: Path, session: Session) -> _Exposure:
    """Write the quantum efficiency that gives the light that was seen, and say with which
    exposure: a longer one where the efficiency would be over 1.
    """
    tracker = session.file.config.tracker
    optics = bench_optics(tracker, session.file.folder)
    curve = corrected(optics.quantum_efficiency, session.light.correction)
    if not len(curve.wavelength_nm):
        curve = Curve(np.array([300.0, 1100.0]), np.full(2, curve.value[0]))
    exposure_s = session.shots[0].photo.exposure_s or tracker.exposure_s or 1.0
    offset_mag = float(session.light.offsets_mag.mean())
    ratio = session.pixels.gain_e_per_dn * flux_ratio(offset_mag) / exposure_s
    largest = max(float(curve.value.max()), 1e-9)
    share = min(ratio, 1.0 / largest)
    lines = ["wavelength_nm,value\n"]
    for nm, value in zip(curve.wavelength_nm, curve.value, strict=True):
        lines.append(f"{nm:.2f},{value * share:.7g}\n")
    write_whole(path, "".join(lines))
    return _Exposure(exposure_s * ratio / share, ratio / share)


def _write_psf(path: Path, session: Session) -> None:
    """Write images of the PSF on a grid of the field, and in the history the model's numbers."""
    psf = session.psf
    light = session.light
    width, height = psf.size_px
    places = []
    images = []
    for x_px in np.linspace(0, width - 1, GRID):
        for y_px in np.linspace(0, height - 1, GRID):
            places.append((x_px, y_px))
            images.append(psf.samples(x_px, y_px, PER_PX, HALF_PX))
    places_px = np.array(places)
    facts = facts_of(len(places_px))
    illumination = light.illumination(radius2_of(session.camera.camera, *places_px.T))
    facts[:, 0] = np.clip(illumination, 0, 2)
    no_wavelength = np.full(len(places_px), np.nan)
    in_focus = np.zeros(len(places_px))
    at = np.column_stack([places_px, no_wavelength, in_focus])
    numbers = {
        "covariance": psf.covariance.tolist(),
        "colour": float(psf.colour),
        "wing": [float(psf.wing_share), float(psf.wing_sigma_px)],
        "vignetting": list(light.vignetting_mag),
    }
    text = json.dumps(numbers, separators=(",", ":"))  # a FITS card loses spaces at its end
    history = ["PSF of photographs, by hilstar confront"]
    for first in range(0, len(text), CARD_CHARACTERS):
        history.append(f"{MODEL}{text[first : first + CARD_CHARACTERS]}")
    stack = Stack(np.stack(images), at, facts, PER_PX, False)
    write_glass(path, glass_of(stack, history=tuple(history)))


def fixed_camera(file: BenchFile, step_dn: float) -> FixedCamera:
    """The camera of a bench file, as --fixed holds photographs against it. Raises InputError."""
    tracker = file.config.tracker
    camera = tracker_camera(tracker, file.folder)
    psf, vignetting = _psf_of(file)
    light = LightFit(np.zeros(1), vignetting, NO_CORRECTION, math.nan, math.nan, 1.0)
    detector = tracker.detector
    # the file's noise has the rounding of a detector of steps of one DN; the photographs' steps
    # may be of several
    rounding2_e2 = (step_dn**2 - 1) / 12 * detector.gain_e_per_dn**2
    read_e = math.sqrt(max(detector.electronics_e**2 - rounding2_e2, 0.0))
    pattern = FixedPattern((detector.prnu**2, 0.0, 0.0, 0.0), (0.0,) * 4)
    pixels = PixelFit(
        gain_e_per_dn=detector.gain_e_per_dn,
        pedestal_dn=detector.offset_dn,
        read_noise_e=read_e,
        step_dn=step_dn,
        sigma={},
        points=np.empty((0, 2)),
        pattern=pattern,
    )
    return FixedCamera(camera, psf, light, pixels)


def _psf_of(file: BenchFile) -> tuple[StarPsf, tuple[float, float]]:
    """The PSF of a bench file and its vignetting: the numbers that confront wrote, else fitted
    to the file's images.
    """
    tracker = file.config.tracker
    size_px = tracker.resolution_px
    psf = tracker_psf(tracker, file.folder)
    if isinstance(psf, GaussianPsf):
        x_px, y_px = psf.width_px
        covariance = np.array([[x_px * x_px], [y_px * y_px], [0.0]])
        return StarPsf(covariance, 0.0, 0.0, 2.0, size_px), (0.0, 0.0)
    glass = glass_in(tracker, file.folder)
    if glass is None:
        stated_psf = read_psf(file.folder / tracker.optics.psf)
        images = np.asarray(stated_psf.samples)[None]
        middle_px = np.array([[size_px[0] / 2, size_px[1] / 2]])
        return _fitted(images, stated_psf.per_px, middle_px, size_px), (0.0, 0.0)
    written = _written_model(glass.history, size_px)
    if written is not None:
        return written
    focus = int(np.abs(glass.focuses_um - tracker.optics.focus_um).argmin())
    images = glass.images[:, :, focus].mean(axis=1)
    illumination = glass.illumination[:, :, focus].mean(axis=1)
    r2 = radius2_of(tracker_camera(tracker, file.folder), *glass.places_px.T)
    fitted = _fitted(images, glass.per_px, glass.places_px, size_px)
    return fitted, vignetting_of(illumination, r2)


def vignetting_of(illumination: FloatArray, radius2: FloatArray) -> tuple[float, float]:
    """The vignetting (mag at r^2 and at r^4 = 1) of light relative to the axis (n,), at squares of
    radii (n,); none by fewer than three.
    """
    if len(radius2) < 3:
        return 0.0, 0.0
    shade_mag = np.log10(np.maximum(illumination, 1e-3)) * -2.5
    design = np.column_stack([radius2, radius2**2])
    a, b = np.linalg.lstsq(design, shade_mag, rcond=None)[0].tolist()
    return a, b


def _written_model(
    history: Iterable[object], size_px: tuple[int, int]
) -> tuple[StarPsf, tuple[float, float]] | None:
    """The PSF and the vignetting by the numbers that confront wrote into a PSF file's history;
    None without them.
    """
    lines = [str(line) for line in history]
    text = "".join(line.removeprefix(MODEL) for line in lines if line.startswith(MODEL))
    if not text:
        return None
    try:
        numbers = msgspec.json.decode(text)
        wing_share, wing_sigma_px = numbers["wing"]
        a, b = numbers["vignetting"]
        covariance = np.array(numbers["covariance"])
        psf = StarPsf(covariance, numbers["colour"], wing_share, wing_sigma_px, size_px)
    except (msgspec.MsgspecError, LookupError, TypeError, ValueError):
        # somebody changed it: the images count
        return None
    return psf, (a, b)


def _fitted(
    images: FloatArray, per_px: int, places_px: FloatArray, size_px: tuple[int, int]
) -> StarPsf:
    """The PSF that fits images (n, side, side) of `per_px` samples a pixel, each at its place:
    as stars of 1e6 DN.
    """
    count, side, _ = images.shape
    step_px = 1 / per_px
    offset_px = (np.arange(side) - side // 2) * step_px
    pixel_px = np.arange(-HALF, HALF + 1)[:, None]
    # a sample on the edge of two pixels is of both, half of it each
    first_px = np.maximum(offset_px - step_px / 2, pixel_px - 0.5)
    last_px = np.minimum(offset_px + step_px / 2, pixel_px + 0.5)
    share = np.maximum(last_px - first_px, 0) / step_px
    values = share @ images @ share.T
    columns, rows = np.rint(places_px).T
    bv_mag = np.full(count, MEAN_BV_MAG)
    stamps = Stamps(1e6 * values, np.full_like(values, 1.0), columns, rows, bv_mag)
    psf = fit_psf(stamps, columns.copy(), rows.copy(), size_px, 1.0)
    return replace(psf, colour=0.0)
