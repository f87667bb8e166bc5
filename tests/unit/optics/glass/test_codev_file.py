"""What a .seq file states, against an own trace (what is refused: test_refusals.py)."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.optics.glass.codev_file import read_codev
from tests.support.lenses import (
    focal_length_mm,
    lit_share,
    numbers_of,
    real_rays,
    rms_radius_um,
    seq,
)
from tests.support.refusals import refusal

FOCAL_MM, TOLERANCE_MM = 100.0308, 2e-4  # as in test_zemax_file.py
LIT_TOLERANCE = 6e-3  # a grid of 160 rays across counts areas to 5 parts in 1000
RMS_TOLERANCE_UM = 0.3  # rays on a square grid; the published figures are of other grids
SINGLET = ((51.68, 4.0, "N-BK7"), (1e12, 97.363, ""))


@pytest.mark.parametrize(
    ("dim", "mm"),
    [
        ("DIM M", 1.0),
        ("DIM I", 25.4),
        ("DIM C", 10.0),
        ("dim i", 25.4),
        ("DIM MM", 1.0),
        ("DIM IN", 25.4),
    ],
)
def test_units_are_scaled(dim, mm):
    lens = read_codev(seq(dim, mm=mm, more={1: ["ASP", f"A {-7e-7 * mm**3!r}", f"CIR {8 / mm!r}"]}))
    assert focal_length_mm(lens) == pytest.approx(FOCAL_MM, abs=TOLERANCE_MM)
    assert lens.pupil == pytest.approx(20)
    assert lens.surfaces[0].polynomial[3] == pytest.approx(-7e-7)
    assert lens.surfaces[0].apertures[0].half_mm[0] == pytest.approx(8)


def seq_of_every_length(dim: str, mm: float, curvatures: bool) -> bytes:
    """A .seq of each statement that is a length, or a power of one, in a unit of so many mm."""
    first, second = (mm / 50, -mm / 80) if curvatures else (50 / mm, -80 / mm)
    terms = "; ".join(f"{term} {1e-9 * mm ** (3 + 2 * k)!r}" for k, term in enumerate("ABCDEFGHJ"))
    text = f"""RDM {"N" if curvatures else "Y"}
DIM {dim}
EPD {20 / mm!r}
WL 550
XIM 0 {2 / mm!r}
YIM 0 {-3 / mm!r}
SO 0 1e11
S {first!r} {4 / mm!r} 1.5:60
STO
ASP; K -0.5
{terms}
CIR {10 / mm!r}; CIR OBS {1 / mm!r}
ADX {0.5 / mm!r}; ADY {-0.25 / mm!r}
S {second!r} {60 / mm!r}
XDE {1.5 / mm!r}; YDE {-2.5 / mm!r}; ZDE {0.75 / mm!r}; ADE 10
REX {8 / mm!r}; REY {7 / mm!r}
SI 0 0"""
    return text.encode()


@pytest.mark.parametrize("curvatures", [False, True], ids=["radii", "curvatures"])
@pytest.mark.parametrize(("dim", "mm"), [("C", 10.0), ("I", 25.4)])
def test_every_length_of_a_lens_is_scaled(dim, mm, curvatures):
    in_mm = numbers_of(read_codev(seq_of_every_length("M", 1.0, curvatures)))
    assert {20.0, -3.0, 1e-9, 10.0, -0.25, 1.5, -2.5, 7.0} <= set(in_mm)
    lens = read_codev(seq_of_every_length(dim, mm, curvatures))
    assert numbers_of(lens) == pytest.approx(in_mm, rel=1e-12)


def test_no_unit_is_mm_and_said():
    lens = read_codev(seq().replace(b"DIM M\n", b""))
    assert focal_length_mm(lens) == pytest.approx(FOCAL_MM, abs=TOLERANCE_MM)
    assert "no DIM" in lens.notes[0]


def test_curvatures_are_curvatures():
    """With RDM N, and without any RDM, which is CODE V's rule; that is said."""
    surfaces = [
        (1 / radius, thickness, glass)
        for radius, thickness, glass in ((61.47, 6.0, "N-BK7"), (-44.64, 2.5, "N-SF5"))
    ]
    surfaces += [(-1 / 129.94, 95.952, "")]
    stated = read_codev(seq("RDM N;LEN", surfaces=surfaces))
    silent = read_codev(seq("RDM N", surfaces=surfaces).replace(b"RDM N\n", b""))
    assert focal_length_mm(stated) == pytest.approx(FOCAL_MM, abs=TOLERANCE_MM)
    assert focal_length_mm(silent) == pytest.approx(FOCAL_MM, abs=TOLERANCE_MM)
    assert not stated.notes and "no RDM" in silent.notes[0]


@pytest.mark.parametrize(
    ("terms", "rms_um"), [([], 55.8), (["ASP", "A -7e-07; B 0.0; C 0.0"], 15.8)]
)
def test_a_is_the_coefficient_of_the_fourth_power(terms, rms_um):
    """The singlet's spot by an own ray trace: 55.8 um as a sphere, 15.8 um with A; A on r^2
    would leave 55.3 um.
    """
    lens = read_codev(seq(surfaces=SINGLET, more={1: terms}))
    assert rms_radius_um(lens) == pytest.approx(rms_um, abs=RMS_TOLERANCE_UM)


def test_coefficients_go_up_to_the_twentieth_power():
    terms = "; ".join(f"{term} {number}e-9" for number, term in enumerate("ABCDEFGHJ", 1))
    polynomial = read_codev(seq(more={1: ["ASP", terms]})).surfaces[0].polynomial
    assert [polynomial[power - 1] for power in range(4, 21, 2)] == pytest.approx(
        [n * 1e-9 for n in range(1, 10)]
    )
    assert not any(polynomial[::2]) and polynomial[1] == 0


@pytest.mark.parametrize(
    ("lines", "share"),
    [
        (["CIR 10", "CIR OBS 5"], 0.75),
        (["CIR OBS L'A' 5"], 0.75),
        (["CIR HOL 5"], 0.75),
        (["CIR 5"], 0.25),
        (["CIR EDG 5"], 1.0),
        (["REX 5; REY 4"], 80 / (math.pi * 100)),
        (["REX OBS 5; REY OBS 4"], 1 - 80 / (math.pi * 100)),
        (["ELX 5", "ELY 4"], 0.2),
    ],
)
def test_apertures_let_through_their_share(lines, share):
    """Of a pupil of 20 mm, at the first surface, by areas."""
    assert lit_share(read_codev(seq(more={1: lines}))) == pytest.approx(share, abs=LIT_TOLERANCE)


def test_a_moved_aperture_is_moved():
    (aperture,) = read_codev(seq(more={1: ["CIR OBS 2", "ADX 4; ADY -1"]})).surfaces[0].apertures
    assert not aperture.passes(4.0, -1.0) and aperture.passes(0.0, 0.0)


@pytest.mark.parametrize(
    ("system", "kind", "pupil"),
    [("EPD 20", "diameter", 20.0), ("FNO 5", "f_number", 5.0), ("NA 0.1", "f_number", 5.0)],
)
def test_the_aperture_is_as_stated(system, kind, pupil):
    lens = read_codev(seq(system))
    assert (lens.pupil_kind, lens.pupil) == (kind, pytest.approx(pupil))


@pytest.mark.parametrize("far", ["1e10", "1e11", "0.1e14", "INF", "993938392063.0", "-1e10"])
def test_a_far_object_is_at_infinity(far):
    assert focal_length_mm(read_codev(seq(far=far))) == pytest.approx(FOCAL_MM, abs=TOLERANCE_MM)


@pytest.mark.parametrize(
    ("code", "index_d", "abbe"),
    [
        ("516800.641700", 1.5168, 64.17),
        ("517.642", 1.517, 64.2),
        ("517642", 1.517, 64.2),
        ("1.5168:64.17", 1.5168, 64.17),
    ],
)
def test_codes_of_glasses_keep_their_digits(code, index_d, abbe):
    glass = read_codev(seq().replace(b"NBK7_SCHOTT", code.encode())).surfaces[0].glass
    assert glass.index_d == pytest.approx(index_d, abs=1e-9) and glass.abbe == pytest.approx(
        abbe, abs=1e-9
    )


@pytest.mark.parametrize("name", ["12345", "51.642", "516.64", "N517642", "5.17.642"])
def test_a_name_of_too_few_digits_or_with_letters_is_no_code(name):
    glass = read_codev(seq().replace(b"NBK7_SCHOTT", name.encode())).surfaces[0].glass
    assert (glass.name, glass.index_d) == (name, None)


def test_a_private_glass_is_refused_where_it_is_used():
    private = "PRV\nPWL 656.3 587.6 486.1\n'E48' 1.5284 1.5311 1.537\nEND"
    assert focal_length_mm(read_codev(seq(private))) == pytest.approx(FOCAL_MM, abs=TOLERANCE_MM)
    with pytest.raises(
        InputError, match=r"surface 1 \(line \d+\) has the private glass E48 \(line 3\)"
    ):
        read_codev(seq(private).replace(b"NBK7_SCHOTT", b"'E48'"))


def test_vignetting_is_shift_and_compression():
    """VUY cuts 0.2 off above, VLY 0.4 below: what is lit is from -0.6 to 0.8 of the pupil."""
    point = read_codev(seq("VUY 0 0.2; VLY 0 0.4")).fields[1]
    assert point.shift[1] + (1 - point.compression[1]) == pytest.approx(0.8)
    assert point.shift[1] - (1 - point.compression[1]) == pytest.approx(-0.6)


def test_lines_go_on_and_comments_end_them():
    text = (
        seq()
        .replace(b"EPD 20.0", b"EPD & ! the pupil\n  20.0 ! mm; not inches")
        .replace(b"GO", b"GO ! FNO 3")
    )
    text = text.replace(b"EPD & ! the pupil", b"EPD &")
    assert read_codev(text).pupil == 20
    assert read_codev(seq("TITLE 'a; b ! c'")).pupil == 20


def test_a_fold_mirror_bends_the_axis():
    """A flat mirror at 45 degrees with BEN: the axis behind it stands at a right angle, and the
    light runs along it.
    """
    lines = [
        "RDM",
        "DIM M",
        "EPD 10",
        "WL 587.5618",
        "YAN 0",
        "SO 0 1e11",
        "S 0 50",
        "S 0 -30 REFL",
        "ADE 45",
        "BEN",
        "SI 0 0",
    ]
    lens = read_codev("\n".join(lines).encode())
    ray = real_rays(lens, np.array([[0.0], [0.0], [-10.0]]), np.array([[0.0], [0.0], [1.0]]))
    assert ray[0][:, 0] == pytest.approx([0, 0, 0], abs=1e-9)
    assert np.abs(ray[1][:, 0]) == pytest.approx([0, 0, 1], abs=1e-9)
    assert np.linalg.norm(
        lens.surfaces[-1].origin_mm - lens.surfaces[1].origin_mm
    ) == pytest.approx(30)
    assert lens.surfaces[-1].origin_mm[2] == pytest.approx(50, abs=1e-9)


def test_a_decentre_with_return_leaves_the_axis():
    """A parabola of 100 mm moved by 40 mm with DAR: the star's image is on the moved axis."""
    lines = [
        "RDM",
        "DIM M",
        "EPD 10",
        "WL 550",
        "YAN 0",
        "SO 0 1e11",
        "S 0 0",
        "S -200 -100 REFL",
        "CON; K -1",
        "DAR; YDE 40",
    ]
    lens = read_codev("\n".join([*lines, "SI 0 0"]).encode())
    at, along = (
        np.array([[1.0, -3.0], [2.0, -4.0], [-150.0, -150.0]]),
        np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 1.0]]),
    )
    assert real_rays(lens, at, along)[0][:2] == pytest.approx(
        np.array([[0, 0], [40, 40]]), abs=1e-9
    )


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-8-sig", "cp1252"])
def test_a_lens_is_the_same_in_every_encoding(encoding):
    lens = read_codev(seq().decode().encode(encoding))
    assert focal_length_mm(lens) == pytest.approx(FOCAL_MM, abs=TOLERANCE_MM)


@pytest.mark.parametrize("words", ["CIR", "CIR 0", "CIR -2"])
def test_an_aperture_without_a_size_is_refused(words):
    assert "has no size; write its half-width" in refusal(read_codev, seq(more={1: [words]}))


@pytest.mark.parametrize("keyword", ["CUF", "IC", "XOD", "YOD", "ZOD"])
def test_what_changes_nothing_at_zero_is_refused_elsewhere(keyword):
    read_codev(seq(f"{keyword} 0"))
    assert f"{keyword} is not known" in refusal(read_codev, seq(f"{keyword} 0.1"))


@pytest.mark.parametrize(
    ("x_deg", "y_deg", "wanted"),
    [
        ("0 1 -2", "0", [(0, 0), (1, 0), (-2, 0)]),
        ("0", "0 1 -2", [(0, 0), (0, 1), (0, -2)]),
        ("0.5", "-1", [(0.5, -1)]),
    ],
)
def test_fields_are_as_many_as_are_listed_on_either_axis(x_deg, y_deg, wanted):
    lens = read_codev(seq(f"XAN {x_deg}", f"YAN {y_deg}"))
    assert [(point.x, point.y) for point in lens.fields] == wanted


def test_a_field_s_pupil_is_cut_by_what_is_above_and_below_along_each_axis():
    """VU and VL are the parts cut off at the upper and the lower edge, of the half width: what
    is left is narrower by half of both, and its middle is moved away from the larger.
    """
    lens = read_codev(
        seq("XAN 0 0", "YAN 0 1", "VUX 0.0 0.2", "VLX 0.0 0.1", "VUY 0.0 0.3", "VLY 0.0 0.5")
    )
    axis, edge = lens.fields
    assert (*axis.compression, *axis.shift) == (0, 0, 0, 0)
    assert edge.compression == pytest.approx((0.15, 0.4))
    assert edge.shift == pytest.approx((-0.05, 0.1))
