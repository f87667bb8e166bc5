"""Makes a lens of optiland from what a lens file states: its surfaces in their own axes, its
glasses by name.

optiland itself looks a glass up by similarity (N-SF11 for SF11), and uses AIR or a placeholder
where it finds none. So its database is searched here, by exact name and catalogue.
"""

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, did_you_mean
from hilstar.optics.glass.lens_data import Aperture, Glass, LensPrescription, LensSurface

# The order in which catalogues are searched for a glass where the lens file names none of them.
CATALOGUE_ORDER = ("schott", "ohara", "hoya", "cdgm", "hikari", "sumita")
# Materials to which catalogues of Zemax (MISC, INFRARED) and of CODE V give names of their own, and
# the published formula that those catalogues use: Malitson 1965 and 1963. Corning states n_d =
# 1.458467 for its 7980, Malitson 1.458464 for fused silica.
MATERIALS = {
    "C79-80": "main/SiO2/Malitson.yml",
    "F_SILICA": "main/SiO2/Malitson.yml",
    "SILICA": "main/SiO2/Malitson.yml",
    "FSILICA": "main/SiO2/Malitson.yml",
    "CAF2": "main/CaF2/Malitson.yml",
}
# Old glasses that the database lacks, and the new ones with the same n_d and V_d to the last digit
# of Schott's data sheets.
SAME_GLASSES = {"bk7": "nbk7"}
# Terms of a conic's series: at 0.8 of the radius at which the surface is upright, the term after
# the last is 1e-8 of the first.
SERIES_TERMS = 40
GLASS_GROUP = "glass"
FURTHER_FOLDER = "misc"  # of a maker's glasses beside its catalogue, such as Schott's B270
FIELD_NAMES = {
    "angle": "angle",
    "paraxial_image_height": "paraxial_image_height",
    "real_image_height": "real_image_height",
}
PUPIL_NAMES = {"diameter": "EPD", "f_number": "imageFNO", "stop": "float_by_stop_size"}


@dataclass(frozen=True, slots=True)
class GlassFile:
    """A material in optiland's database, with the wavelengths at which it is known, um. Name and
    catalogue are in small letters and digits only.
    """

    name: str
    catalogue: str
    filename: str
    shortest_um: float
    longest_um: float
    is_glass: bool


def optic_of(lens: LensPrescription) -> tuple[Any, tuple[str, ...]]:
    """optiland's Optic of a lens, and notes for the user on how its glasses were read.

    Raises InputError for a glass that no catalogue has, or that is not known at a wavelength.
    """
    from optiland.optic import Optic

    optic = Optic()
    files, notes = glass_files(lens)
    optic.surfaces.add(index=0, radius=np.inf, thickness=np.inf)
    has_stop = any(surface.is_stop for surface in lens.surfaces)
    for number, (surface, file) in enumerate(zip(lens.surfaces, files, strict=True), 1):
        material = _material(surface.glass, file)
        is_stop = surface.is_stop or (not has_stop and number == 1)
        optic.surfaces.add(index=number, material=material, is_stop=is_stop, **_geometry(surface))
    optic.set_aperture(aperture_type=PUPIL_NAMES[lens.pupil_kind], value=lens.pupil)
    optic.fields.set_type(field_type=FIELD_NAMES[lens.field_kind])
    for point in lens.fields:
        optic.fields.add(x=point.x, y=point.y)
    for number, um in enumerate(lens.wavelengths_um):
        optic.wavelengths.add(value=um, is_primary=number == lens.primary)
    return optic, notes


def glass_files(lens: LensPrescription) -> tuple[list[GlassFile | None], tuple[str, ...]]:
    """The material in optiland's database behind each surface of a lens, None for air, a mirror and
    an index of its own; and notes for the user on how glasses were read, each once.

    Raises InputError as `optic_of` does.
    """
    files: list[GlassFile | None] = []
    notes: list[str] = []
    for surface in lens.surfaces:
        glass = surface.glass
        if glass.is_mirror or glass.is_air or glass.index_d is not None:
            files.append(None)
            continue
        file, more = find_glass(glass, surface.label)
        _check_wavelengths(file, surface, lens.wavelengths_um)
        files.append(file)
        notes += more
    return files, tuple(dict.fromkeys(notes))


def _check_wavelengths(
    file: GlassFile, surface: LensSurface, wavelengths_um: Sequence[float]
) -> None:
    """Raise InputError for a glass that is not known at a wavelength of the lens."""
    for um in wavelengths_um:
        if not file.shortest_um <= um <= file.longest_um:
            raise InputError(
                f"{surface.label}: {surface.glass.name} is known from {file.shortest_um:g} to"
                f" {file.longest_um:g} um, and the lens is for {um:g} um; write a wavelength"
                " within, or another glass"
            )


def _geometry(surface: LensSurface) -> dict[str, Any]:
    x_mm, y_mm, z_mm = surface.origin_mm.tolist()
    rx, ry, rz = _euler_rad(surface.turn)
    # optiland's paraxial rays use the base sphere alone, so a term in r^2 is made part of it.
    curvature = surface.paraxial_curvature_per_mm
    radius_mm = 1 / curvature if curvature else np.inf
    made: dict[str, Any] = {
        "x": x_mm,
        "y": y_mm,
        "z": z_mm,
        "rx": rx,
        "ry": ry,
        "rz": rz,
        "radius": radius_mm,
    }
    if surface.paraxial_focal_mm is not None:
        made |= {"surface_type": "paraxial", "f": surface.paraxial_focal_mm}
    else:
        made |= {"conic": surface.conic, **_shape(surface)}
    if surface.apertures:
        made["aperture"] = _mask(surface.apertures)
    return made


def _shape(surface: LensSurface) -> dict[str, Any]:
    terms = _terms_beside_base(surface)
    if not terms.any():
        return {"surface_type": "standard"}
    if terms[::2].any():
        return {"surface_type": "odd_asphere", "coefficients": terms.tolist()}
    return {"surface_type": "even_asphere", "coefficients": terms[1::2].tolist()}


def _terms_beside_base(surface: LensSurface) -> FloatArray:
    """The coefficients of r, r^2, ... (lengths in mm) of a surface, to be added to a base conic
    that has the surface's curvature at its vertex.
    """
    terms = np.array(surface.polynomial)
    if len(terms) < 2 or not terms[1]:
        return terms
    stated = _conic_series(surface.curvature_per_mm, surface.conic)
    base = _conic_series(surface.paraxial_curvature_per_mm, surface.conic)
    whole = np.zeros(2 * SERIES_TERMS)
    whole[: len(terms)] = terms
    whole[1::2] += stated - base
    whole[1] = 0.0
    return whole


def _conic_series(curvature_per_mm: float, conic: float) -> FloatArray:
    """The coefficients of r^2, r^4, ... (SERIES_TERMS,) of a conic's height, lengths in mm: the
    binomial series of its root.
    """
    binomial = 1.0
    coefficients = []
    for number in range(1, SERIES_TERMS + 1):
        binomial *= (1.5 - number) / number
        scale = (1 + conic) ** (number - 1) * curvature_per_mm ** (2 * number - 1)
        coefficients.append(-binomial * (-1.0) ** number * scale)
    return np.array(coefficients)


def _euler_rad(turn: FloatArray) -> list[float]:
    """The three angles, rad, of a rotation matrix (3, 3) as optiland turns: about the fixed x axis,
    then y, then z.
    """
    angles_rad = Rotation.from_matrix(turn).as_euler("xyz")
    # optiland takes its fast path for lenses without tilts only where angles are exactly 0.
    angles_rad[np.abs(angles_rad) < np.finfo(np.float64).eps] = 0.0
    return list(angles_rad.tolist())


def _mask(apertures: Sequence[Aperture]) -> Any:
    """All apertures of a surface as a single aperture of optiland."""
    from optiland.physical_apertures.base import BaseAperture

    class Mask(BaseAperture):  # type: ignore[misc]
        """All apertures of a surface as one: light passes it where it passes each of them."""

        @property
        def extent(self) -> tuple[float, float, float, float]:
            width_mm, height_mm = np.max([aperture.half_mm for aperture in apertures], axis=0)
            return -width_mm, width_mm, -height_mm, height_mm

        def contains(self, x: Any, y: Any) -> Any:
            passed = [aperture.passes(x, y) for aperture in apertures]
            return np.logical_and.reduce(passed)

        def scale(self, scale_factor: float) -> None:
            raise InputError("a lens's apertures are not scaled")

    return Mask()


def _material(glass: Glass, file: GlassFile | None) -> Any:
    """optiland's material of a glass, whose file is that of `glass_files`."""
    if glass.is_mirror:
        return "mirror"
    if glass.index_d is not None:
        return _model(glass)
    if file is None:
        return "air"
    from optiland.materials.material_file import MaterialFile

    folder = resources.files("optiland.database").joinpath("data-nk")
    return MaterialFile(str(Path(str(folder)) / file.filename))


def _model(glass: Glass) -> Any:
    from optiland.materials.base import BaseMaterial

    class ModelGlass(BaseMaterial):  # type: ignore[misc]
        """A glass whose index the lens file itself states."""

        def _calculate_n(self, wavelength: Any, **_: Any) -> Any:
            return glass.model_index(np.asarray(wavelength))

        def _calculate_k(self, wavelength: Any, **_: Any) -> Any:
            return np.zeros_like(np.asarray(wavelength, dtype=np.float64))

    return ModelGlass()


def find_glass(glass: Glass, label: str) -> tuple[GlassFile, list[str]]:
    """The material in optiland's database with a glass's exact name, and notes for the user on
    which of several it is.

    Raises InputError, which begins with `label`, where no catalogue has it.
    """
    name = _plain(glass.name)
    by_name = [file for file in _database() if file.name == name]
    listed = [_plain(catalogue) for catalogue in glass.catalogues]
    for catalogue in listed:
        # SCHOTT_2014 and SCHOTT are catalogues of one maker, so the beginning of a name counts.
        for file in by_name:
            if catalogue.startswith(file.catalogue):
                return file, []
    if glass.name in MATERIALS:
        filename = MATERIALS[glass.name]
        return next(file for file in _database() if file.filename == filename), []
    glasses = sorted((file for file in by_name if file.is_glass), key=_place_in_order)
    if name in SAME_GLASSES and not glasses:
        same = next(file for file in _database() if file.name == SAME_GLASSES[name])
        taken = f"{glass.name} is taken as N-{glass.name}, whose n_d and V_d are the same"
        return same, [f"{label}: {taken}"]
    if not glasses:
        unknown = f"the glass {glass.name} is in no catalogue{_where(glass)}"
        raise InputError(f"{label}: {unknown}; {_instead(glass.name, name)}")
    if listed:
        makers = ", ".join(file.catalogue for file in glasses)
        raise InputError(
            f"{label}: the glass {glass.name} is not of {', '.join(glass.catalogues)}, but of"
            f" {makers}; name that catalogue beside it, or write the glass's n and V"
        )
    return glasses[0], [f"{label}: {glass.name} is taken as {glasses[0].catalogue}'s"]


def _where(glass: Glass) -> str:
    if glass.catalogues:
        return f" (the file names {', '.join(glass.catalogues)})"
    return ""


def _instead(written: str, plain: str) -> str:
    """A text that says what to write for a glass that no catalogue has. Its maker may have a
    successor (N-SF11 for SF11), which is a different glass.
    """
    glasses = [file for file in _database() if file.is_glass]
    for file in glasses:
        if file.name == f"n{plain}":
            newer = f"N-{written} ({file.catalogue})"
            return f"{newer} is another glass: write it, or the glass's own n and V"
    likely = did_you_mean(written, {file.name.upper() for file in glasses})
    return f"{likely}write a glass of a maker's catalogue, or its n and V (a model glass)"


def _place_in_order(file: GlassFile) -> int:
    known = file.catalogue in CATALOGUE_ORDER
    if known:
        return CATALOGUE_ORDER.index(file.catalogue)
    return len(CATALOGUE_ORDER)


def _plain(name: str) -> str:
    """A name in small letters and digits only, as CODE V writes NBK7 for N-BK7."""
    return "".join(character for character in name.lower() if character.isalnum())


@lru_cache(maxsize=1)
def _database() -> tuple[GlassFile, ...]:
    return tuple(_read_database())


def _read_database() -> Iterator[GlassFile]:
    table = resources.files("optiland.database").joinpath("catalog_nk.csv")
    with table.open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            parts = row["filename"].removesuffix(".yml").split("/")
            parts = [part for part in parts if part != FURTHER_FOLDER]
            # glass/MAKER/NAME, and main/MATERIAL/AUTHOR; deeper ones are forms of a glass (melts,
            # infrared parts).
            if len(parts) != 3:
                continue
            is_glass = parts[0] == GLASS_GROUP
            name, catalogue = (parts[2], parts[1]) if is_glass else (parts[1], parts[2])
            yield GlassFile(
                _plain(name),
                _plain(catalogue),
                row["filename"],
                float(row["min_wavelength"]),
                float(row["max_wavelength"]),
                is_glass,
            )
