"""What a .zmx file states, against an own trace (what is refused: test_refusals.py)."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hilstar.optics.glass.zemax_file import read_zemax
from tests.support.lenses import focal_length_mm, lit_share, numbers_of, zmx

# of the doublet, by the own trace in `tests/support/lenses.py`; its maker states 100 mm
FOCAL_MM = 100.0308
TOLERANCE_MM = 2e-4  # the file's five digits of focal length
LIT_TOLERANCE = 6e-3  # a grid of 160 rays across counts areas to 5 parts in 1000


def test_the_doublet_has_its_focal_length():
    lens = read_zemax(zmx())
    assert focal_length_mm(lens) == pytest.approx(FOCAL_MM, abs=TOLERANCE_MM)
    assert lens.pupil_kind == "diameter" and lens.pupil == 20
    assert lens.fields[1].y == 1.0 and lens.wavelengths_um == (0.5875618,)
    assert not lens.notes


@pytest.mark.parametrize(
    ("unit", "mm"),
    [("MM", 1.0), ("IN", 25.4), ("CM", 10.0), ("METER", 1000.0), ("M", 1000.0), ("in", 25.4)],
)
def test_units_are_scaled(unit, mm):
    """Lengths, curvatures, asphere terms and apertures of one lens are the same in every unit."""
    more = {1: [f"  PARM 1 {1e-3 * mm!r}", f"  PARM 2 {-7e-7 * mm**3!r}", f"  CLAP 0 {8 / mm!r} 0"]}
    text = zmx(unit=unit, mm=mm, more=more).replace(b"TYPE STANDARD", b"TYPE EVENASPH")
    lens = read_zemax(text)
    assert focal_length_mm(read_zemax(zmx(unit=unit, mm=mm))) == pytest.approx(
        FOCAL_MM, abs=TOLERANCE_MM
    )
    assert lens.pupil == pytest.approx(20)
    assert lens.surfaces[0].polynomial[1] == pytest.approx(1e-3)
    assert lens.surfaces[0].polynomial[3] == pytest.approx(-7e-7)
    assert lens.surfaces[0].apertures[0].half_mm[0] == pytest.approx(8)


def zmx_of_every_length(unit: str, mm: float) -> bytes:
    """A .zmx of each statement that is a length, or a power of one, in a unit of so many mm."""
    system = f"""MODE SEQ
UNIT {unit} X W X CM MR CPMM
FLOA
FTYP 3 0 2 1 0 0 0
XFLN 0 {2 / mm!r}
YFLN 0 {-3 / mm!r}
WAVM 1 0.55 1
SURF 0
  DISZ INFINITY
SURF 1
  STOP
  TYPE EVENASPH
  CURV {mm / 50!r}
  CONI -0.5
  PARM 1 {1e-3 * mm!r}
  PARM 2 {2e-5 * mm**3!r}
  PARM 8 {3e-19 * mm**15!r}
  DIAM {11 / mm!r} 1
  CLAP {1 / mm!r} {10 / mm!r}
  OBDC {0.5 / mm!r} {-0.25 / mm!r}
  DISZ {4 / mm!r}
SURF 2
  TYPE COORDBRK
  PARM 1 {1.5 / mm!r}
  PARM 2 {-2.5 / mm!r}
  PARM 3 10
  DISZ {7 / mm!r}
SURF 3
  TYPE ODDASPHE
  CURV {-mm / 80!r}
  PARM 1 0.01
  PARM 2 {2e-4 * mm!r}
  PARM 3 {3e-6 * mm**2!r}
  PARM 8 {4e-16 * mm**7!r}
  SPID {2 / mm!r} 3
  ELOB {6 / mm!r} {5 / mm!r}
  DISZ {9 / mm!r}
SURF 4
  TYPE PARAXIAL
  PARM 1 {60 / mm!r}
  SQAP {8 / mm!r} {7 / mm!r}
  DISZ {60 / mm!r}
SURF 5
  TYPE STANDARD
  DISZ 0"""
    return system.encode()


@pytest.mark.parametrize(("unit", "mm"), [("CM", 10.0), ("IN", 25.4), ("METER", 1000.0)])
def test_every_length_of_a_lens_is_scaled(unit, mm):
    in_mm = numbers_of(read_zemax(zmx_of_every_length("MM", 1.0)))
    assert {22.0, 60.0, 2e-5, 3e-19, 0.01, 4e-16, -0.25, 8.0} <= set(in_mm)
    assert numbers_of(read_zemax(zmx_of_every_length(unit, mm))) == pytest.approx(in_mm, rel=1e-12)


@pytest.mark.parametrize("far", ["INFINITY", "1.0E+010", "1e10", "1E+13", "inf", "-1e10"])
def test_a_far_object_is_at_infinity(far):
    assert focal_length_mm(read_zemax(zmx(far=far))) == pytest.approx(FOCAL_MM, abs=TOLERANCE_MM)


def test_the_air_of_which_catalogues_give_indices_may_be_stated():
    for words in ("20 1 1", "20 1 0", "25 0.5 0"):  # 0: no index is adjusted
        assert read_zemax(zmx("ENPD 20", f"ENVD {words}")).pupil == 20.0


@pytest.mark.parametrize(
    ("lines", "kind", "pupil"),
    [
        (("ENPD 20",), "diameter", 20.0),
        (("FNUM 5 0",), "f_number", 5.0),
        (
            ("FNUM 5 1",),
            "f_number",
            5.0,
        ),  # the paraxial working F-number, which is the same for a far object
        (("FLOA",), "stop", 20.0),  # DIAM 10 is a semi-diameter
    ],
)
def test_the_aperture_is_as_stated(lines, kind, pupil):
    lens = read_zemax(zmx(*lines, more={1: ['  DIAM 10 1 0 0 1 ""']}))
    assert (lens.pupil_kind, lens.pupil) == (kind, pupil)


def test_one_field_on_the_axis_is_one_field():
    lens = read_zemax(zmx().replace(b"FTYP 0 0 2 1", b"FTYP 0 0 1 1"))
    assert [(point.x, point.y) for point in lens.fields] == [(0.0, 0.0)]


@pytest.mark.parametrize(
    ("count", "x_deg", "y_deg", "wanted"),
    [
        (3, "0 1 -2", "0 0 0", [(0, 0), (1, 0), (-2, 0)]),
        (3, "0 0 0", "0 1 -2", [(0, 0), (0, 1), (0, -2)]),
        (3, "0", "0 1 -2", [(0, 0), (0, 1), (0, -2)]),
        (3, "0 1 -2", "0", [(0, 0), (1, 0), (-2, 0)]),
        (2, "0 1 -2", "0 0 0", [(0, 0), (1, 0)]),  # there is room for one more
        (5, "0 1 -2", "0 0 0", [(0, 0), (1, 0), (-2, 0)]),  # more than there are
        (0, "0 1", "0 0", [(0, 0), (1, 0)]),
    ],
)
def test_fields_are_as_many_as_counted_and_listed_on_either_axis(count, x_deg, y_deg, wanted):
    text = zmx(f"FTYP 0 0 {count} 1", "ENPD 20", f"XFLN {x_deg}", f"YFLN {y_deg}")
    assert [(point.x, point.y) for point in read_zemax(text).fields] == wanted


@pytest.mark.parametrize(
    ("count", "wanted_um"),
    [(2, (0.6, 0.5)), (3, (0.6, 0.5, 0.7)), (9, (0.6, 0.5, 0.7)), (0, (0.6, 0.5, 0.7))],
)
def test_wavelengths_are_as_many_as_counted_each_once(count, wanted_um):
    """By the fourth number of FTYP, in both ways to list them; the third counts fields."""
    waves = ("WAVM 1 0.6 1", "WAVM 2 0.5 1", "WAVM 3 0.7 1")
    for lines in (waves, ("WAVL 0.6 0.5 0.7",)):
        text = zmx("ENPD 20", f"FTYP 0 0 1 {count}", "PWAV 2", *lines)
        if "WAVL" in lines[0]:
            text = text.replace(b"WAVM 1 0.5875618 1\r\n", b"")
        lens = read_zemax(text)
        assert (lens.wavelengths_um, lens.primary) == (wanted_um, 1)


@pytest.mark.parametrize(
    ("line", "share"),
    [
        ("  OBSC 0 5 0", 0.75),
        ("  OBSC 3 5 0", 1 - 0.16),
        ("  CLAP 5 10 0", 0.75),
        ("  FLAP 0 5 0", 0.25),
        ("  SQAP 5 4 0", 80 / (math.pi * 100)),
        ("  SQOB 5 4 0", 1 - 80 / (math.pi * 100)),
        ("  ELAP 5 4 0", 0.2),
        ("  ELOB 5 4 0", 0.8),
        ("  SPID 1 4 0", 1 - (2 * 20 - 1) / (math.pi * 100)),
    ],
)
def test_apertures_let_through_their_share(line, share):
    """Of a pupil of 20 mm, at the first surface, by areas."""
    assert lit_share(read_zemax(zmx(more={1: [line]}))) == pytest.approx(share, abs=LIT_TOLERANCE)


@pytest.mark.parametrize(
    ("line", "centre_mm"),
    [
        ("  OBSC 0 5 0", (12.0, -3.0)),
        ("  CLAP 0 5 0", (12.0, -3.0)),
        ("  SQAP 5 5 0", (12.0, -3.0)),
        ("  FLAP 0 5 0", (0.0, 0.0)),  # the surface's own edge
    ],
)
def test_what_is_beside_the_vertex_is_there(line, centre_mm):
    """Whether light passes changes at the edge, 5 mm from its centre to either side along x and
    along y.
    """
    lens = read_zemax(zmx(more={1: [line, "  OBDC 12 -3"]}))
    (aperture,) = lens.surfaces[0].apertures
    within = aperture.passes(*centre_mm)
    across = np.array([[-4.9, 4.9, 0, 0], [0, 0, -4.9, 4.9]])
    x_mm, y_mm = np.array(centre_mm)[:, None] + across
    assert (aperture.passes(x_mm, y_mm) == within).all()
    x_mm, y_mm = np.array(centre_mm)[:, None] + across * (5.1 / 4.9)
    assert (aperture.passes(x_mm, y_mm) != within).all()


def test_the_editors_lists_behind_the_lens_are_passed_over():
    behind = [
        "EFLY 2 13 0 0 0 0 4.94E+1 9.9E+1 0 0",
        "TOL TOFF   0   0   0   0   0 0 0",
        "MNUM 1 1",
        'MOFF   0   1 "" 0 0 0',
    ]
    assert focal_length_mm(read_zemax(zmx(behind=behind))) == pytest.approx(
        FOCAL_MM, abs=TOLERANCE_MM
    )


def test_a_model_glass_has_its_numbers():
    lens = read_zemax(
        zmx(
            more={
                1: ["  GLAS ___BLANK 1 0 1.5168 64.17 0.0"],
                2: ["  GLAS ___BLANK 1 0 1.67271 0 0"],
            }
        )
    )
    first, second = (surface.glass for surface in lens.surfaces[:2])
    assert float(first.model_index(0.5875618)) == pytest.approx(1.5168)
    dispersion = float(first.model_index(0.4861327) - first.model_index(0.6562725))
    assert 0.5168 / dispersion == pytest.approx(64.17)
    # V of 0 is a constant index.
    assert second.model_index(np.array([0.4, 0.9])).tolist() == [1.67271, 1.67271]


def test_a_picked_up_model_glass_has_its_numbers():
    lens = read_zemax(zmx(more={2: ["  GLAS ___BLANK 2 0 1.67271 32.25 0 0 0"]}))
    assert (lens.surfaces[1].glass.index_d, lens.surfaces[1].glass.abbe) == (1.67271, 32.25)


def test_a_glass_keeps_its_name_and_its_catalogues():
    lens = read_zemax(zmx().replace(b"GLAS N-SF5", b"GLAS SF11"))
    assert lens.surfaces[1].glass.name == "SF11"
    assert lens.surfaces[1].glass.catalogues == ("SCHOTT",)


def test_vignetting_factors_shift_and_compress():
    factors = b"VDYN 0 -0.1\r\nVCYN 0 0.2\r\nVCXN 0 0.05\r\nWAVM 1"
    lens = read_zemax(zmx().replace(b"WAVM 1", factors, 1))
    assert lens.fields[1].compression == (0.05, 0.2) and lens.fields[1].shift == (0.0, -0.1)
    assert not lens.fields[0].is_vignetted


@pytest.mark.parametrize("line", ["CURV 0.01", "DISZ 3", "GLAS N-F2 0 0", "CONI -1"])
def test_a_surface_s_line_may_stand_twice_alike(line):
    assert len(read_zemax(zmx(more={2: [f"  {line}"] * 2})).surfaces) == 4


ENCODINGS = ("utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-8-sig", "cp1252")


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_lens_is_the_same_in_every_encoding(encoding):
    lens = read_zemax(zmx(more={1: ["  COMM 'été'"]}).decode().encode(encoding))
    assert focal_length_mm(lens) == pytest.approx(FOCAL_MM, abs=TOLERANCE_MM)
