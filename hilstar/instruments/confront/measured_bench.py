"""The bench file that photographs give of a tracker, and the files that it names; and such a
file read back.
"""

import json
import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.files import write_whole
from hilstar.basics.reading import MAX_TOML_BYTES, parse_toml, read_text
from hilstar.instruments.confront.background import FixedPattern
from hilstar.instruments.confront.light import NO_CORRECTION, LightFit
from hilstar.instruments.confront.photon_transfer import PixelFit
from hilstar.instruments.confront.session import FixedCamera, Session, corrected, radius2_of
from hilstar.instruments.confront.star_psf import HALF, STAMP_PX, Stamps, StarPsf, fit_psf
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
# a 24 inch screen, for a bench whose file has no monitor
SCREEN_PX, SCREEN_PITCH_UM, FILLED = (1920, 1080), 265.5, 0.95
PLACEHOLDER = (
    "[monitor]\nresolution_px = [1920, 1080]\npixel_pitch_um = 265.5\n[collimator]\nfocal_length_mm"
    " = 1000.0\n"
)
UNDATED = '[sky]\nepoch_utc = "2000-01-01T00:00:00Z"\n'
NAMES = ("tracker.toml", "tracker_distortion.toml", "tracker_qe.csv", "tracker_psf.fits")
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
}
PATH_KEYS |= {"true_calibration", "true_geometry"}


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
    return (
        bench_file_of(path, text if has_screen else f"{text.rstrip()}\n{PLACEHOLDER}"),
        has_screen,
    )


def write_tracker(folder: Path, session: Session, has_screen: bool) -> Path:
    """Write the camera of a session as a bench file and the files it names. Raises InputError
    where they cannot be written.
    """
    camera = session.camera.camera
    pixels = session.pixels
    tracker = session.file.config.tracker
    lens = camera.lens or Lens()
    sigma = session.camera.sigma
    lines = [f"# fitted to {len(session.shots)} photographs: {session.camera.model}"]
    for name, value in zip(
        ("k1", "k2", "p1", "p2"), (*lens.radial[:2], *lens.tangential), strict=True
    ):
        lines.append(
            f"{name} = {value:.9g}" + (f"  # +- {sigma[name]:.2g}" if name in sigma else "")
        )
    write_whole(folder / NAMES[1], "\n".join(lines) + "\n")
    times, exposure_s = _write_efficiency(folder / NAMES[2], session)
    _write_psf(folder / NAMES[3], session)
    # twice that of a mosaic's plane
    pitch_um = tracker.pixel_pitch_um * tracker.resolution_px[0] / camera.resolution_px[0]
    table: dict[str, Any] = {
        "aperture_mm": tracker.aperture_mm,
        "focal_length_mm": camera.focal_length_px * pitch_um * 1e-3,
        "pixel_pitch_um": pitch_um,
        "resolution_px": list(camera.resolution_px),
        "principal_point_px": [round(v, 4) for v in camera.principal_point_px],
        "quantum_efficiency": NAMES[2],
        "transmission": tracker.transmission,
        "exposure_s": exposure_s,
        "distortion": NAMES[1],
    }
    if tracker.frame_hz is not None:
        table["frame_hz"] = tracker.frame_hz
    given_tables = parse_toml(session.file.path, session.file.text)
    detector = _detector(session, given_tables["tracker"].get("detector", {}))
    tables: dict[str, Any] = {
        "tracker": table | {"optics": {"psf": NAMES[3]}, "detector": detector}
    }
    sky = _dated_sky(session, given_tables)
    if session.air is not None and session.shots[0].photo.t_ns is not None:
        tables["site"] = {
            k: v for k, v in given_tables.get("site", {}).items() if not k.startswith("sky_")
        }
    tables["sky"] = sky
    level = float(np.median([np.median(shot.level.level) for shot in session.shots]))
    tables["background"] = {
        "electrons_per_px": max((level - pixels.pedestal_dn) * pixels.gain_e_per_dn, 0.0)
    }
    for name in ("monitor", "collimator"):
        tables[name] = dict(given_tables.get(name, {}))
    if not has_screen:
        half = [size / 2 / camera.focal_length_px for size in camera.resolution_px]
        screen = [size * SCREEN_PITCH_UM * 1e-3 for size in SCREEN_PX]
        focal_mm = FILLED * min(
            side / 2 / tangent for side, tangent in zip(screen, half, strict=True)
        )
        tables["monitor"] = {"resolution_px": list(SCREEN_PX), "pixel_pitch_um": SCREEN_PITCH_UM}
        tables["collimator"] = {"focal_length_mm": round(focal_mm, 1)}
    tables |= {
        k: v
        for k, v in given_tables.items()
        if k not in tables and k in {"render", "attitude", "verify", "sync"}
    }
    notes = [
        f"By hilstar confront from {', '.join(shot.photo.name for shot in session.shots)}.",
        "Aperture and exposure are those that were given"
        + (
            f", but more light came than they give: exposure_s is {times:.3g} times it."
            if times > 1
            else "."
        ),
        f"The gain: {pixels.gain_words}.",
        *(
            []
            if has_screen
            else [
                "The monitor and the collimator are examples that fill the field: write your own."
            ]
        ),
        *(
            [f"DN are those of the file, made linear: to the power {1 / session.power:.4f}."]
            if session.power != 1
            else []
        ),
    ]
    path = folder / NAMES[0]
    text = "".join(f"# {note}\n" for note in notes) + "\n".join(
        _toml(_absolute(tables, session.file.folder))
    )
    write_whole(path, text + "\n")
    return path


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
    absolute: dict[str, Any] = {}
    for key, value in tables.items():
        if isinstance(value, dict):
            absolute[key] = _absolute(value, folder)
        elif key in PATH_KEYS and isinstance(value, str) and (folder / value).is_file():
            absolute[key] = str((folder / value).resolve())
        else:
            absolute[key] = value
    return absolute


def _toml(table: dict[str, Any], name: str = "") -> Iterable[str]:
    """Lines of a table and those in it; JSON and TOML write numbers, truth values, lists and
    plain text alike.
    """
    if name:
        yield f"\n[{name}]"
    yield from (
        f"{key} = {json.dumps(value)}"
        for key, value in table.items()
        if not isinstance(value, dict)
    )
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _toml(value, f"{name}.{key}" if name else key)


def _write_efficiency(path: Path, session: Session) -> tuple[float, float]:
    """Write the quantum efficiency that gives the light that was seen; how much longer the
    exposure has to be, and it, s.
    """
    tracker = session.file.config.tracker
    optics = bench_optics(tracker, session.file.folder)
    curve = corrected(optics.quantum_efficiency, session.light.correction)
    if not len(curve.wavelength_nm):
        curve = Curve(np.array([300.0, 1100.0]), np.full(2, curve.value[0]))
    exposure_s = session.shots[0].photo.exposure_s or tracker.exposure_s or 1.0
    wanted = (
        session.pixels.gain_e_per_dn
        * 10 ** (-0.4 * float(session.light.offsets_mag.mean()))
        / exposure_s
    )
    share = min(wanted, 1.0 / max(float(curve.value.max()), 1e-9))
    rows = "\n".join(
        f"{nm:.2f},{value * share:.7g}"
        for nm, value in zip(curve.wavelength_nm, curve.value, strict=True)
    )
    write_whole(path, f"wavelength_nm,value\n{rows}\n")
    return wanted / share, exposure_s * wanted / share


def _write_psf(path: Path, session: Session) -> None:
    psf = session.psf
    light = session.light
    width, height = psf.size_px
    across, down = (np.linspace(0, size - 1, GRID) for size in (width, height))
    places = np.array([(x, y) for x in across for y in down])
    images = np.stack([psf.samples(x, y, PER_PX, HALF_PX) for x, y in places])
    facts = facts_of(len(places))
    facts[:, 0] = np.clip(light.illumination(radius2_of(session.camera.camera, *places.T)), 0, 2)
    at = np.column_stack([places, np.full(len(places), np.nan), np.zeros(len(places))])
    numbers = {
        "covariance": psf.covariance.tolist(),
        "colour": float(psf.colour),
        "wing": [float(psf.wing_share), float(psf.wing_sigma_px)],
        "vignetting": list(light.vignetting_mag),
    }
    text = json.dumps(numbers, separators=(",", ":"))  # a FITS card loses spaces at its end
    parts = [f"{MODEL}{text[k : k + 60]}" for k in range(0, len(text), 60)]
    write_glass(
        path,
        glass_of(
            Stack(images, at, facts, PER_PX, False),
            history=("PSF of photographs, by hilstar confront", *parts),
        ),
    )


def fixed_camera(file: BenchFile, step_dn: float) -> FixedCamera:
    """The camera of a bench file, as --fixed holds photographs against it. Raises InputError."""
    tracker = file.config.tracker
    camera = tracker_camera(tracker, file.folder)
    psf, vignetting = _psf_of(file)
    light = LightFit(np.zeros(1), vignetting, NO_CORRECTION, math.nan, math.nan, 1.0)
    detector = tracker.detector
    read_e = math.sqrt(
        max(detector.electronics_e**2 - (step_dn**2 - 1) / 12 * detector.gain_e_per_dn**2, 0.0)
    )
    pixels = PixelFit(
        detector.gain_e_per_dn,
        detector.offset_dn,
        read_e,
        step_dn,
        {},
        np.empty((0, 2)),
        (),
        FixedPattern((detector.prnu**2, 0.0, 0.0, 0.0), (0.0,) * 4),
    )
    return FixedCamera(camera, psf, light, pixels)


def _psf_of(file: BenchFile) -> tuple[StarPsf, tuple[float, float]]:
    """The PSF of a bench file and its vignetting: the numbers that confront wrote, else fitted
    to the file's images.
    """
    tracker = file.config.tracker
    size = tracker.resolution_px
    psf = tracker_psf(tracker, file.folder)
    if isinstance(psf, GaussianPsf):
        x, y = psf.width_px
        return StarPsf(np.array([[x * x], [y * y], [0.0]]), 0.0, 0.0, 2.0, size), (0.0, 0.0)
    glass = glass_in(tracker, file.folder)
    if glass is None:
        stated_psf = read_psf(file.folder / tracker.optics.psf)
        return _fitted(
            np.asarray(stated_psf.samples)[None],
            stated_psf.per_px,
            np.array([[size[0] / 2, size[1] / 2]]),
            size,
        ), (0.0, 0.0)
    model_text = "".join(
        str(line).removeprefix(MODEL) for line in glass.history if str(line).startswith(MODEL)
    )
    if model_text:
        try:
            numbers = msgspec.json.decode(model_text)
            wing_share, wing_sigma = numbers["wing"]
            a, b = numbers["vignetting"]
            return StarPsf(
                np.array(numbers["covariance"]), numbers["colour"], wing_share, wing_sigma, size
            ), (a, b)
        except (msgspec.MsgspecError, LookupError, TypeError, ValueError):
            # somebody changed it: the images count
            pass
    focus = int(np.abs(glass.focuses_um - tracker.optics.focus_um).argmin())
    images = glass.images[:, :, focus].mean(axis=1)
    light = np.log10(np.maximum(glass.illumination[:, :, focus].mean(axis=1), 1e-3)) * -2.5
    r2 = radius2_of(tracker_camera(tracker, file.folder), *glass.places_px.T)
    a, b = (
        np.linalg.lstsq(np.column_stack([r2, r2**2]), light, rcond=None)[0].tolist()
        if len(r2) > 2
        else (0.0, 0.0)
    )
    return _fitted(images, glass.per_px, glass.places_px, size), (a, b)


def _fitted(
    images: FloatArray, per_px: int, places_px: FloatArray, size_px: tuple[int, int]
) -> StarPsf:
    """The PSF that fits images (n, side, side) of `per_px` samples a pixel, each at its place:
    as stars of 1e6 DN.
    """
    stamps = np.zeros((len(images), STAMP_PX, STAMP_PX))
    middle = images.shape[-1] // 2
    offsets = np.rint((np.arange(images.shape[-1]) - middle) / per_px).astype(np.intp)
    is_near = np.abs(offsets) <= HALF
    at = offsets[is_near] + HALF
    for stamp, image in zip(stamps, images, strict=True):
        np.add.at(stamp, (at[:, None], at[None, :]), image[np.ix_(is_near, is_near)])
    columns, rows = np.rint(places_px).T
    level = Stamps(
        1e6 * stamps, np.full_like(stamps, 1.0), columns, rows, np.full(len(stamps), 0.65)
    )
    return replace(fit_psf(level, columns.copy(), rows.copy(), size_px, 1.0), colour=0.0)
