"""What of a lens optiland is given: shapes and angles in closed form, glasses by exact names. None of
it needs optiland, whose database is planted here.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.optics.glass import optiland_lens
from hilstar.optics.glass.codev_file import read_codev
from hilstar.optics.glass.lens_data import (
    Aperture,
    FieldPoint,
    Glass,
    LensPrescription,
    LensSurface,
)
from hilstar.optics.glass.optiland_lens import (
    GlassFile,
    _euler_rad,
    _terms_beside_base,
    find_glass,
    glass_files,
    optic_of,
)
from tests.support.lenses import seq
from tests.support.refusals import refusal

SAG_MM = 1e-9  # of forty terms of the series at half of the radius at which a surface is upright


def file_of(name: str, catalogue: str, *, is_glass: bool = True) -> GlassFile:
    folder = "glass" if is_glass else "main"
    return GlassFile(name, catalogue, f"{folder}/{catalogue}/{name}.yml", 0.3, 2.5, is_glass)


NBK7, NSF5, NSF11 = (file_of(name, "schott") for name in ("nbk7", "nsf5", "nsf11"))
SF11, OHARA_BSL7 = file_of("sf11", "schott"), file_of("bsl7", "ohara")
TWO_MAKERS = (file_of("f2", "hoya"), file_of("f2", "schott"))
SILICA = GlassFile("sio2", "malitson", "main/SiO2/Malitson.yml", 0.21, 6.7, False)
DATABASE = (NBK7, NSF5, NSF11, SF11, OHARA_BSL7, *TWO_MAKERS, SILICA)


@pytest.fixture(autouse=True)
def planted_database(monkeypatch):
    monkeypatch.setattr(optiland_lens, "_database", lambda: DATABASE)


def lens_of(*glasses: Glass) -> LensPrescription:
    """A lens with a surface before each of the glasses, and the image."""
    lens = read_codev(seq())
    surfaces = []
    for number, glass in enumerate((*glasses, Glass()), 1):
        surfaces.append(replace(lens.surfaces[0], label=f"surface {number}", glass=glass))
    return replace(lens, surfaces=tuple(surfaces))


def test_every_note_of_a_lens_is_said_once_and_what_is_no_glass_needs_none():
    old, other = Glass("BK7", ("SCHOTT",)), Glass("F2")
    lens = lens_of(old, other, Glass("MIRROR"), Glass("own", index_d=1.5), old, Glass("NSF5"))
    files, notes = glass_files(lens)
    assert files == [NBK7, TWO_MAKERS[1], None, None, NBK7, NSF5, None]
    taken = "BK7 is taken as N-BK7, whose n_d and V_d are the same"
    assert notes == (
        f"surface 1: {taken}",
        "surface 2: F2 is taken as schott's",
        f"surface 5: {taken}",
        "surface 6: NSF5 is taken as schott's",
    )


@pytest.mark.parametrize(
    ("name", "catalogues", "file"),
    [
        ("N-SF11", ("SCHOTT",), NSF11),
        ("SF11", ("SCHOTT",), SF11),  # another glass than N-SF11
        ("NSF11", ("SCHOTT_2014",), NSF11),
        ("F2", ("OHARA", "HOYA"), TWO_MAKERS[0]),
        ("SILICA", ("MISC",), SILICA),
        ("S-BSL7", ("OHARA",), "surface 1: the glass S-BSL7 is in no catalogue"),
        ("BSL7", ("SCHOTT",), "surface 1: the glass BSL7 is not of SCHOTT, but of ohara;"),
        ("SF5", (), "N-SF5 (schott) is another glass: write it, or the glass's own n and V"),
    ],
)
def test_a_glass_is_the_one_of_its_exact_name_and_catalogue(name, catalogues, file):
    lens = lens_of(Glass(name, catalogues))
    if isinstance(file, str):
        assert file in refusal(glass_files, lens)
        return
    files, notes = glass_files(lens)
    assert files == [file, None]
    assert notes == ()


@pytest.mark.parametrize(
    ("um", "is_known"), [(0.299, False), (0.3, True), (2.5, True), (2.51, False)]
)
def test_a_glass_is_refused_at_a_wavelength_at_which_it_is_not_known(um, is_known):
    lens = replace(lens_of(Glass("N-BK7", ("SCHOTT",))), wavelengths_um=(0.55, um))
    if is_known:
        assert glass_files(lens)[0] == [NBK7, None]
    else:
        assert "surface 1: N-BK7 is known from 0.3 to 2.5 um" in refusal(glass_files, lens)


@pytest.mark.parametrize("curvature", [0.0, 1 / 50, -1 / 80])
@pytest.mark.parametrize("conic", [0.0, -0.5, -1.0, 0.3])
@pytest.mark.parametrize("polynomial", [(0.0, 2e-3, 0.0, 1e-6), (0.0, -1e-3, 3e-6), (0.0, 4e-3)])
def test_a_term_in_r_squared_is_part_of_the_base_and_the_height_stays(curvature, conic, polynomial):
    """The height is that of the stated conic and terms, whatever conic is at its base."""
    surface = replace(
        lens_of().surfaces[0], curvature_per_mm=curvature, conic=conic, polynomial=polynomial
    )
    base = surface.paraxial_curvature_per_mm
    steepest = max(abs(curvature), abs(base)) * np.sqrt(max(1 + conic, 0.0))
    r_mm = np.linspace(0.0, min(0.5 / steepest if steepest else 20.0, 20.0), 9)
    terms = _terms_beside_base(surface)
    assert terms[1] == 0
    height = conic_mm(base, conic, r_mm) + power_sum(terms, r_mm)
    stated = conic_mm(curvature, conic, r_mm) + power_sum(polynomial, r_mm)
    assert height == pytest.approx(stated, abs=SAG_MM)


def conic_mm(curvature: float, conic: float, r_mm: np.ndarray) -> np.ndarray:
    root = np.sqrt(1 - (1 + conic) * (curvature * r_mm) ** 2)
    return curvature * r_mm**2 / (1 + root)


def power_sum(terms: np.ndarray | tuple[float, ...], r_mm: np.ndarray) -> np.ndarray:
    """Of coefficients of r, r^2, ..."""
    return sum(term * r_mm**power for power, term in enumerate(terms, 1))


def test_a_surface_s_angles_turn_about_fixed_x_then_y_then_z(rng):
    for turn in Rotation.random(20, rng=rng).as_matrix():
        x, y, z = _euler_rad(turn)
        about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
        about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
        about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
        assert about_z @ about_y @ about_x == pytest.approx(turn, abs=1e-12)
    assert _euler_rad(np.eye(3)) == [0.0, 0.0, 0.0]


def test_of_a_glass_of_several_makers_the_first_in_the_order_is_taken(monkeypatch):
    """A maker that the order does not know comes last; the note says whose it is."""
    makers = tuple(file_of("k7", maker) for maker in ("lzos", "sumita", "hikari"))
    monkeypatch.setattr(optiland_lens, "_database", lambda: makers)
    file, notes = find_glass(Glass("K7"), "surface 1")
    assert (file.catalogue, notes) == ("hikari", ["surface 1: K7 is taken as hikari's"])
    monkeypatch.setattr(optiland_lens, "_database", lambda: makers[:1])
    assert find_glass(Glass("K7"), "surface 1")[0].catalogue == "lzos"


# What hilstar asks of optiland: an Optic notes what is added to it, the rest are names to build on.
OPTILAND = {
    "__init__.py": "",
    "optic.py": """
class Part(list):
    def add(self, **given): self.append(given)
    def set_type(self, **given): self.append(given)

class Optic:
    def __init__(self): self.surfaces, self.fields, self.wavelengths = Part(), Part(), Part()
    def set_aperture(self, **given): self.aperture = given
""",
    "materials/__init__.py": "",
    "materials/base.py": "class BaseMaterial: pass",
    "materials/material_file.py": "MaterialFile = str",
    "physical_apertures/__init__.py": "",
    "physical_apertures/base.py": "class BaseAperture: pass",
    "database/__init__.py": "",
    "database/catalog_nk.csv": """filename,min_wavelength,max_wavelength
glass/schott/N-BK7.yml,0.3,2.5
glass/schott/infrared/N-SF5.yml,0.4,2.4
glass/misc/schott/B270.yml,0.35,2.0
main/SiO2/Malitson.yml,0.21,6.7
""",
}


def taken_out() -> dict[str, ModuleType]:
    """The modules of optiland that were imported, which are no longer."""
    names = [name for name in sys.modules if name.partition(".")[0] == "optiland"]
    return {name: sys.modules.pop(name) for name in names}


@pytest.fixture
def planted_optiland(tmp_path, monkeypatch):
    for name, text in OPTILAND.items():
        path = tmp_path / "optiland" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(optiland_lens, "_database", lambda: tuple(optiland_lens._read_database()))
    own = taken_out()
    yield tmp_path / "optiland"
    taken_out()
    sys.modules.update(own)


def test_the_database_s_glasses_and_materials_are_by_name_and_maker(planted_optiland):
    """A maker's further glasses are its own; a form of a glass (in a deeper folder) is none."""
    for glass, wanted in (
        (Glass("B270", ("SCHOTT",)), ("b270", "schott", 0.35, 2.0, True)),
        (Glass("SILICA"), ("sio2", "malitson", 0.21, 6.7, False)),
    ):
        file, notes = find_glass(glass, "surface 1")
        limits_um = file.shortest_um, file.longest_um
        assert (file.name, file.catalogue, *limits_um, file.is_glass) == wanted
        assert notes == []
    assert "N-SF5 is in no catalogue" in refusal(find_glass, Glass("N-SF5"), "surface 1")


def test_optiland_is_given_each_surface_in_its_axes_the_pupil_fields_and_wavelengths(
    planted_optiland,
):
    level = {"turn": np.eye(3), "origin_mm": np.zeros(3)}
    angles_rad = [0.1, -0.2, 0.3]
    tilted = {
        "turn": Rotation.from_euler("xyz", angles_rad).as_matrix(),
        "origin_mm": np.array([1.0, -2.0, 30.0]),
    }
    masks = (
        Aperture("circle", (4.0, 4.0), True),
        Aperture("rectangle", (1.0, 5.0), False, centre_mm=(3.0, 0.0)),
    )
    schott, own, air = Glass("NBK7", ("SCHOTT",)), Glass("own", index_d=1.6), Glass()
    surfaces = (
        LensSurface("1", 0.02, -0.5, (), schott, (), False, **level),
        LensSurface("2", 0.0, 0.0, (0.0, 0.0, 0.0, 1e-6), own, masks, True, **level),
        LensSurface("3", 0.0, 0.0, (1e-3, 0.0, 2e-6), Glass("MIRROR"), (), False, **tilted),
        LensSurface("4", 0.0, 0.0, (), air, (), False, **level, paraxial_focal_mm=60.0),
    )
    fields = (FieldPoint(0.0, 1.0), FieldPoint(1.5, -2.0))
    lens = LensPrescription(
        surfaces, "f_number", 5.0, "real_image_height", fields, (0.6, 0.5, 0.7), 1
    )
    optic, notes = optic_of(lens)
    space, first, second, mirror, thin = optic.surfaces
    assert space == {"index": 0, "radius": np.inf, "thickness": np.inf}
    here = dict.fromkeys(("x", "y", "z", "rx", "ry", "rz"), 0.0)
    nbk7 = str(planted_optiland / "database/data-nk/glass/schott/N-BK7.yml")
    shape = {"radius": 50.0, "conic": -0.5, "surface_type": "standard"}
    assert first == {"index": 1, "material": nbk7, "is_stop": False, **here, **shape}
    material, aperture = second.pop("material"), second.pop("aperture")
    shape = {"surface_type": "even_asphere", "coefficients": [0.0, 1e-6], "conic": 0.0}
    assert second == {"index": 2, "is_stop": True, **here, "radius": np.inf, **shape}
    assert float(material._calculate_n(0.55)) == 1.6 and float(material._calculate_k(0.55)) == 0
    assert aperture.contains([0, 3, 2, 4.1], [3.9, 0, 3, 0]).tolist() == [True, False, False, False]
    assert aperture.extent == (-4.0, 4.0, -5.0, 5.0)
    there = dict(zip(here, (1.0, -2.0, 30.0, *angles_rad), strict=True))
    assert {name: mirror[name] for name in there} == pytest.approx(there)
    told = [mirror[name] for name in ("index", "material", "surface_type", "coefficients")]
    assert told == [3, "mirror", "odd_asphere", [1e-3, 0.0, 2e-6]]
    shape = {"surface_type": "paraxial", "f": 60.0, "radius": np.inf}
    assert thin == {"index": 4, "material": "air", "is_stop": False, **here, **shape}
    assert optic.aperture == {"aperture_type": "imageFNO", "value": 5.0}
    places = [{"x": 0.0, "y": 1.0}, {"x": 1.5, "y": -2.0}]
    assert optic.fields == [{"field_type": "real_image_height"}, *places]
    waves = zip((0.6, 0.5, 0.7), (False, True, False), strict=True)
    assert optic.wavelengths == [{"value": um, "is_primary": main} for um, main in waves]
    assert notes == ()
    without = replace(lens, surfaces=tuple(replace(each, is_stop=False) for each in surfaces))
    stops = [given["is_stop"] for given in optic_of(without)[0].surfaces[1:]]
    assert stops == [True, False, False, False]
