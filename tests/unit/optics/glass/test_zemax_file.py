"""What a .zmx file states, against an own trace; and that what is not known is refused by its
line.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.optics.glass.zemax_file import read_zemax
from tests.support.lenses import focal_length_mm, lit_share, zmx

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
    ("unit", "mm"), [("MM", 1.0), ("IN", 25.4), ("CM", 10.0), ("METER", 1000.0), ("in", 25.4)]
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


def test_another_unit_is_refused():
    with pytest.raises(InputError, match=r"line 3: UNIT is FT; write MM, CM, IN or METER"):
        read_zemax(zmx(unit="FT"))


@pytest.mark.parametrize("far", ["INFINITY", "1.0E+010", "1e10", "1E+13", "inf"])
def test_a_far_object_is_at_infinity(far):
    assert focal_length_mm(read_zemax(zmx(far=far))) == pytest.approx(FOCAL_MM, abs=TOLERANCE_MM)


def test_a_near_object_is_refused():
    with pytest.raises(InputError, match="its object is near"):
        read_zemax(zmx(far="9e9"))


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


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (("OBNA 0.1 0",), "OBNA is of a near object"),
        (("FLOA",), "FLOA takes the aperture from its DIAM, which is 0"),
        (("ENPD 20", "FNUM 5 0"), r"stated 2 times \(ENPD, FNUM\)"),
        (("NAME no aperture",), r"stated 0 times \(none\)"),
        (("ENPD 0",), "no aperture above 0"),
        (("ENPD twenty",), 'ENPD has "twenty" where a number stands'),
    ],
)
def test_an_aperture_that_says_nothing_is_refused(lines, words):
    with pytest.raises(InputError, match=words):
        read_zemax(zmx(*lines))


def test_one_field_on_the_axis_is_one_field():
    lens = read_zemax(zmx().replace(b"FTYP 0 0 2 1", b"FTYP 0 0 1 1"))
    assert [(point.x, point.y) for point in lens.fields] == [(0.0, 0.0)]


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


def test_a_moved_obstruction_is_moved():
    lens = read_zemax(zmx(more={1: ["  OBSC 0 5 0", "  OBDC 12 0"]}))
    (aperture,) = lens.surfaces[0].apertures
    assert aperture.passes(0.0, 0.0) and not aperture.passes(9.0, 0.0)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("  USAP lens.uda", r"USAP at surface 1 is an aperture of a shape of its own"),
        ("  PKUP 2", "PKUP at surface 1 takes its aperture from another surface"),
        ("  SCBD 1 0 0 0 0 90 0 0", "SCBD at surface 1 tilts or moves the surface"),
        ("  XDAT 1 3.0 0 0 1 0 0", "XDAT at surface 1 gives further coefficients"),
        ("  PARM 2 1e-5", r"PARM 2 of surface 1 \(STANDARD\) is not known"),
        ("  FRNL 3 4", "FRNL at surface 1 is not known"),
        (
            "FRNL 3 4 5 6 7 8 9",
            "FRNL at surface 1 is not known",
        ),  # not indented, as an operand of the merit function
        ("  CLAP 0 0 0", "CLAP at surface 1 has no size"),
        ("  TYPE DGRATING", r"TYPE at surface 1 is DGRATING; write one of STANDARD"),
        ("  GLAS ___BLANK 1 0 0.5 40", "GLAS at surface 1 is a model of n = 0.5"),
        ("  GLAS N-BK7 4 0 0.01 0", "GLAS at surface 1 offsets the index of N-BK7"),
    ],
)
def test_what_is_not_known_is_refused_by_its_line(line, words):
    with pytest.raises(InputError, match=r"line \d+: " + words):
        read_zemax(zmx(more={1: [line]}))


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("MODE NSC", "MODE is NSC"),
        ("APOD 1", "APOD is not known"),
        ("ENVD 20 0.5 1", "ENVD adjusts indices to 20 C and 0.5 atm"),
        ("VANN 0 30", "VANN turns the vignetted pupil"),
        ("ZVCY 0.1 0.0", "ZVCY is not known"),
        ("FTYP 1 0 2 1 0 0 0", r"FTYP has fields of kind 1 \(object heights are 1\)"),
        ("FTYP 0 1 2 1 0 0 0", "FTYP says that the object's side is telecentric"),
    ],
)
def test_what_a_system_line_says_is_used_or_refused(line, words):
    with pytest.raises(InputError, match=words):
        read_zemax(zmx("ENPD 20", line))


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
    with pytest.raises(InputError, match="MNUM says 3 configurations"):
        read_zemax(zmx(behind=["MNUM 3 1"]))


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


def test_utf_16_and_bytes_that_are_no_text_are_read_or_refused():
    assert focal_length_mm(read_zemax(zmx().decode().encode("utf-16"))) == pytest.approx(
        FOCAL_MM, abs=TOLERANCE_MM
    )
    with pytest.raises(InputError):
        read_zemax(bytes(range(256)) * 20)


def test_a_wide_pupil_on_a_small_sphere_is_refused():
    with pytest.raises(
        InputError,
        match=r"surface 1 \(line \d+\) has a radius of 61.47 mm, and the pupil is 200 mm wide",
    ):
        read_zemax(zmx("ENPD 200"))


ENCODINGS = ("utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-8-sig", "cp1252")


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_lens_is_the_same_in_every_encoding(encoding):
    lens = read_zemax(zmx(more={1: ["  COMM 'été'"]}).decode().encode(encoding))
    assert focal_length_mm(lens) == pytest.approx(FOCAL_MM, abs=TOLERANCE_MM)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["WAVM 1 550 1"], "its wavelength is 550 um: is it in another unit"),
        (["WAVM 1 5.5e-7 1"], "its wavelength is 5.5e-07 um"),
        (["ENPD 20", "ENPD 10"], "ENPD says otherwise than line"),
        (["UNIT MM", "ENPD 20", "UNIT IN"], "UNIT says otherwise than line"),
    ],
)
def test_a_system_that_contradicts_itself_is_refused(lines, words):
    if not any(line.startswith("ENPD") for line in lines):
        lines = [*lines, "ENPD 20"]
    with pytest.raises(InputError, match=words):
        read_zemax(zmx(*lines))


@pytest.mark.parametrize("keyword", ["CURV 0.01", "DISZ 3", "GLAS N-F2 0 0", "CONI -1"])
def test_a_surface_s_line_that_stands_twice_is_refused(keyword):
    twice = [f"  {keyword}", f"  {keyword}5"]
    with pytest.raises(InputError, match=r"line \d+: [A-Z]+ at surface 2 says otherwise than line"):
        read_zemax(zmx(more={2: twice}))
    same = zmx(more={2: [f"  {keyword}"] * 2})
    assert len(read_zemax(same).surfaces) == 4


@pytest.mark.parametrize("behind", ["SURF 4", "GLAS N-SF5", "DISZ 2.5", "SURF 2"])
def test_a_file_that_is_cut_off_has_no_image_and_is_refused(behind):
    """A lens of fewer surfaces has another focal length, and nothing else would say so."""
    text = zmx().decode()
    with pytest.raises(InputError, match=r"is the last, .*is the file cut off\?"):
        read_zemax(text[: text.index(behind)].encode())
