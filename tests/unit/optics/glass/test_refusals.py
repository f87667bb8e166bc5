"""Lens files that are refused: what is written, and the words of the one line that says so."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits

from hilstar.optics.glass import psf_file
from hilstar.optics.glass.codev_file import read_codev
from hilstar.optics.glass.maps import glass_of_map
from hilstar.optics.glass.prescription import Plate, glass_of_prescription
from hilstar.optics.glass.psf_file import glass_of, read_glass, write_glass
from hilstar.optics.glass.zemax_file import read_zemax
from hilstar.sky.spectrum import Curve
from tests.support.glass import stack
from tests.support.lenses import seq, zmx
from tests.support.refusals import refusal


def cut_off(behind: str) -> bytes:
    text = zmx()
    return text[: text.index(behind.encode())]


def zmx_surface(*lines: str, number: int = 1) -> bytes:
    return zmx(more={number: [f"  {line}" for line in lines]})


def seq_surface(*lines: str) -> bytes:
    return seq(more={1: list(lines)})


TWICE = r"line \d+: {} at surface 2 says otherwise than line"
CUT_OFF = r"is the last, .*is the file cut off\?"
ZEMAX = [
    (zmx(unit="FT"), "line 3: UNIT is FT; write MM, CM, IN or METER"),
    (zmx(far="9e9"), "its object is near"),
    (zmx("OBNA 0.1 0"), "OBNA is of a near object"),
    (zmx("FLOA"), "FLOA takes the aperture from its DIAM, which is 0"),
    (zmx("ENPD 20", "FNUM 5 0"), r"stated 2 times \(ENPD, FNUM\)"),
    (zmx("NAME no aperture"), r"stated 0 times \(none\)"),
    (zmx("ENPD 0"), "no aperture above 0"),
    (zmx("ENPD twenty"), 'ENPD has "twenty" where a number stands'),
    (
        zmx("ENPD 200"),
        r"surface 1 \(line \d+\) has a radius of 61.47 mm, and the pupil is 200 mm wide",
    ),
    (
        zmx("ENPD 200", surfaces=((-61.47, 6.0, "N-BK7"), (44.64, 95.0, ""))),
        r"surface 1 \(line \d+\) has a radius of -61.47 mm, and the pupil is 200 mm wide",
    ),
    (
        zmx_surface("USAP lens.uda"),
        r"line \d+: USAP at surface 1 is an aperture of a shape of its own",
    ),
    (zmx_surface("PKUP 2"), r"line \d+: PKUP at surface 1 takes its aperture from another surface"),
    (
        zmx_surface("SCBD 1 0 0 0 0 90 0 0"),
        r"line \d+: SCBD at surface 1 tilts or moves the surface",
    ),
    (
        zmx_surface("XDAT 1 3.0 0 0 1 0 0", "XDAT 2 0.0 0 0 1 0 0"),
        r"line \d+: XDAT at surface 1 gives further coefficients",
    ),
    (zmx_surface("PARM 2 1e-5"), r"line \d+: PARM 2 of surface 1 \(STANDARD\) is not known"),
    (zmx_surface("FRNL 3 4"), r"line \d+: FRNL at surface 1 is not known"),
    # not indented, as an operand of the merit function
    (zmx(more={1: ["FRNL 3 4 5 6 7 8 9"]}), r"line \d+: FRNL at surface 1 is not known"),
    (zmx_surface("CLAP 0 0 0"), r"line \d+: CLAP at surface 1 has no size"),
    (zmx_surface("OBSC -1 5 0"), r"line \d+: OBSC at surface 1 has no size"),
    (zmx_surface("SQAP 0 5 0"), r"line \d+: SQAP at surface 1 has no size"),
    (zmx_surface("ELOB 0 5 0"), r"line \d+: ELOB at surface 1 has no size"),
    (
        zmx_surface("TYPE DGRATING"),
        r"line \d+: TYPE at surface 1 is DGRATING; write one of STANDARD",
    ),
    (zmx_surface("GLAS ___BLANK 1 0 0.5 40"), r"line \d+: GLAS at surface 1 is a model of n = 0.5"),
    (
        zmx_surface("GLAS N-BK7 4 0 0.01 0"),
        r"line \d+: GLAS at surface 1 offsets the index of N-BK7",
    ),
    (zmx("ENPD 20", "MODE NSC"), "MODE is NSC"),
    (zmx("ENPD 20", "APOD 1"), "APOD is not known"),
    (zmx("ENPD 20", "ENVD 20 0.5 1"), "ENVD adjusts indices to 20 C and 0.5 atm"),
    (zmx("ENPD 20", "VANN 0 30"), "VANN turns the vignetted pupil"),
    (zmx("ENPD 20", "ZVCY 0.1 0.0"), "ZVCY is not known"),
    (zmx("ENPD 20", "FTYP 1 0 2 1 0 0 0"), r"FTYP has fields of kind 1 \(object heights are 1\)"),
    (zmx("ENPD 20", "FTYP 0 1 2 1 0 0 0"), "FTYP says that the object's side is telecentric"),
    (zmx(behind=["MNUM 3 1"]), "MNUM says 3 configurations"),
    (zmx("WAVM 1 550 1", "ENPD 20"), "its wavelength is 550 um: is it in another unit"),
    (zmx("WAVM 1 5.5e-7 1", "ENPD 20"), "its wavelength is 5.5e-07 um"),
    (zmx("ENPD 20", "ENPD 10"), "ENPD says otherwise than line"),
    (zmx("UNIT MM", "ENPD 20", "UNIT IN"), "UNIT says otherwise than line"),
    (zmx_surface("CURV 0.01", "CURV 0.015", number=2), TWICE.format("CURV")),
    (zmx_surface("DISZ 3", "DISZ 35", number=2), TWICE.format("DISZ")),
    (zmx_surface("GLAS N-F2 0 0", "GLAS N-F2 0 05", number=2), TWICE.format("GLAS")),
    (zmx_surface("CONI -1", "CONI -15", number=2), TWICE.format("CONI")),
    # A lens of fewer surfaces has another focal length, and nothing else would say so.
    (cut_off("SURF 4"), CUT_OFF),
    (cut_off("GLAS N-SF5"), CUT_OFF),
    (cut_off("DISZ 2.5"), CUT_OFF),
    (cut_off("SURF 2"), CUT_OFF),
    (bytes(range(256)) * 20, ""),
    (b"VERS 140124 258 36214\r\nMODE SEQ\r\n", "it has no SURF"),
    (zmx("ENPD 20", "PWAV 2"), "PWAV names wavelength 2 of 1; write one that there is"),
    (zmx("ENPD 20", "PWAV 0"), "PWAV names wavelength 0 of 1"),
    (zmx("FLOA", more={1: ["  CURV 0.01"]}).replace(b"  STOP\r\n", b""), "no surface says STOP"),
    (zmx(more={2: ["  STOP"]}), "it has two stops; write one"),
]
CODEV = [
    (seq("DIM F"), "DIM is F; write M"),
    (
        seq("RDM").replace(b"RDM\n", b""),
        r"surface 1 \(line \d+\) has 61.47, which without RDM is a curvature.*write RDM Y",
    ),
    (
        seq("RDM", surfaces=((-61.47, 6.0, "N-BK7"), (44.64, 95.0, ""))).replace(b"RDM\n", b""),
        r"surface 1 \(line \d+\) has -61.47, which without RDM is a curvature",
    ),
    (
        # the way to a mirror's image is negative
        seq("RDM", surfaces=((0.5, -100.0, ""),)).replace(b"RDM\n", b""),
        r"surface 1 \(line \d+\) has 0.5, which without RDM is a curvature",
    ),
    (seq_surface("CYL"), "CYL at surface 1"),
    (seq_surface("DIF DOE"), "DIF at surface 1"),
    (seq_surface("HCO C1 -0.0018"), "HCO at surface 1"),
    (seq_surface("CUX 0.01"), "CUX at surface 1"),
    (seq_surface("REV"), "REV at surface 1"),
    (seq_surface("CUF 0.01"), "CUF at surface 1"),
    (seq_surface("GRT"), "GRT at surface 1"),
    (seq_surface("ARO 30"), "ARO at surface 1"),
    (seq_surface("K S3 -1"), "K at surface 1"),
    (seq_surface("REX 5"), "REX has no REY beside it"),
    (seq_surface("CIR 0"), "CIR at surface 1"),
    (seq_surface("CIR WHAT 5"), "CIR at surface 1"),
    (seq_surface("CIR S1 8"), r"line \d+: CIR at surface 1 .* has S1"),
    (
        seq_surface("ASP", "A 1e-7 B 1e-10"),
        r"line \d+: A at surface 1 .* has B 1e-10 behind it; put ;",
    ),
    (seq_surface("K -1", "K -2"), r"line \d+: K at surface 1 .* says otherwise than line"),
    (seq_surface("// a comment"), r"line \d+: // at surface 1 .* is not known"),
    (seq("NAO 0.1"), "NAO is of a near object"),
    (seq("TEM 40"), "TEM puts the lens at 40 C"),
    (seq("POL Y"), "POL asks for polarised rays"),
    (seq("ZOO 2"), "ZOO is not known"),
    (seq("YIM 0 1"), "in angles and in image heights"),
    (
        seq().replace(b"WL 587.5618", b"WL 0.5875618"),
        "its wavelength is 0.000587562 um",
    ),
    (seq().replace(b"NBK7_SCHOTT", b"5168:64.2"), "has the glass 5168:64.2; write n:V"),
    (seq(far="900.0"), "its object is near"),
    (seq().replace(b"\nSI 0.0 0.0", b""), r"it has no image surface \(SI\)"),
    (seq().replace(b"\nSO 0.0 0.1e14", b""), r"it has no object surface \(SO\)"),
    (seq().replace(b"WL 587.5618\n", b""), r"it has no wavelengths \(WL\)"),
    (seq().replace(b"REF 1", b"REF 2"), "REF names wavelength 2 of 1; write one that there is"),
]
REFUSED = [
    *((read_zemax, text, words) for text, words in ZEMAX),
    *((read_codev, text, words) for text, words in CODEV),
]


LENS = read_zemax(zmx())
LACKING = [
    ({"surfaces": LENS.surfaces[-1:]}, "it has no surfaces between object and image"),
    ({"wavelengths_um": ()}, "it has no wavelength above 0"),
    ({"wavelengths_um": (0.5, 0.0)}, "it has no wavelength above 0"),
    ({"wavelengths_um": (0.5, 80.0)}, "its wavelength is 80 um: is it in another unit"),
    ({"primary": 1}, "its primary wavelength is number 2 of 1"),
    ({"primary": -1}, "its primary wavelength is number 0 of 1"),
    ({"pupil": 0.0}, "it has no aperture above 0"),
    ({"surfaces": tuple(replace(each, is_stop=True) for each in LENS.surfaces)}, "two stops"),
]


@pytest.mark.parametrize(("changes", "words"), LACKING, ids=[words for _, words in LACKING])
def test_a_lens_that_cannot_be_traced_says_what_it_lacks(changes, words):
    assert LENS.check() is LENS
    assert words in refusal(replace(LENS, **changes).check)


@pytest.mark.parametrize("name", ["lens.txt", "lens.zmx.bak", "lens"])
def test_a_file_of_another_name_is_no_lens(tmp_path, name):
    (tmp_path / name).write_bytes(zmx())
    plate = Plate((64, 64), 10.0)
    line = refusal(glass_of_prescription, tmp_path / name, plate, None, 1e-3)
    assert "no lens file by its name" in line


def test_what_a_lens_file_lacks_is_said_with_its_name_before_optiland_is_asked_for(tmp_path):
    (tmp_path / "lens.zmx").write_bytes(zmx("ENPD 0"))
    plate = Plate((64, 64), 10.0)
    line = refusal(glass_of_prescription, tmp_path / "lens.zmx", plate, None, 1e-3)
    assert line.startswith(f"{tmp_path / 'lens.zmx'}: it has no aperture above 0")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"no FITS at all", "not a FITS image"),
        (np.zeros(5), "an array of 1 axes"),
        (np.zeros((2, 3, 5, 5)), "an array of 4 axes"),
    ],
    ids=["text", "a line", "four axes"],
)
def test_a_stack_of_a_map_is_images(tmp_path, content, words):
    path = tmp_path / "stack.fits"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        fits.writeto(path, content)
    (tmp_path / "points.csv").write_text("x_px,y_px\n1,2\n")
    line = refusal(glass_of_map, path, tmp_path / "points.csv", 3, False, 1e-3)
    assert line.startswith(f"{path}: ")
    assert words in line


GLASS = glass_of(stack(2, (450.0, 650.0)))


def changed(tmp_path, spoil) -> str:
    """Why the file of a glass is refused once `spoil` has changed its parts."""
    path = tmp_path / "glass.fits"
    write_glass(path, replace(GLASS, transmission=Curve(np.array([400.0, 700.0]), np.ones(2))))
    with fits.open(path, mode="update") as hdus:
        spoil(hdus)
    return refusal(read_glass, path).removeprefix(f"{path}: ")


def put(unit: str | int, column: str, place, value):
    def spoil(hdus):
        hdus[unit].data[column][place] = value

    return spoil


def rolled(samples: int, axis: int):
    def spoil(hdus):
        hdus[0].data = np.roll(hdus[0].data, samples, axis)

    return spoil


SPOILT = [
    (put("POINTS", "x_px", 0, np.nan), "x_px, y_px or focus_um is not finite"),
    (put("POINTS", "focus_um", 0, np.inf), "x_px, y_px or focus_um is not finite"),
    (put("POINTS", "weights", (0, 0), np.inf), "a place, a focus, a weight or a sample is not fin"),
    (put("POINTS", "weights", (0, 0), 0.5), "the PSF at (0, 0) px, 450 nm sums to "),
    (put("POINTS", "weights", (0, 0), 1.5), "the PSF at (0, 0) px, 450 nm sums to "),
    (put("POINTS", "lateral_x_px", 0, np.nan), "a place, a focus, a weight or a sample is not fin"),
    (put("POINTS", "outside_share", 0, 1.0), "outside_share is not within 0 to 1"),
    (put("POINTS", "relative_illumination", 0, -0.1), "relative_illumination is not within 0 to 2"),
    (put("POINTS", "wavelength_nm", 0, np.nan), "the point (0, 0) px has 0 images of 450 nm"),
    (put("TRANSMISSION", "wavelength_nm", 1, 300.0), "the table TRANSMISSION has wavelengths that"),
    (put("TRANSMISSION", "transmission", 1, 1.1), "the table TRANSMISSION has wavelengths that do"),
    (put("TRANSMISSION", "transmission", 0, -0.1), "the table TRANSMISSION has wavelengths that d"),
    (lambda hdus: hdus[0].header.set("PSFVERS", 99), "PSFVERS is 99, and this hilstar reads"),
    (lambda hdus: hdus[0].header.set("OVERSAMP", 2.5), "OVERSAMP is 2.5 and PIXINT False"),
    (lambda hdus: hdus[0].header.set("PIXINT", 1), "OVERSAMP is 4 and PIXINT 1"),
    (lambda hdus: hdus[0].header.set("OVERSAMP", 0), "PSFs of 0 samples a pixel"),
    (
        lambda hdus: setattr(hdus[0], "data", hdus[0].data[:, :, :-1]),
        "its first image is no cube of odd width and height",
    ),
    (
        lambda hdus: setattr(hdus[0], "data", hdus[0].data[:-1]),
        "write one weight for each",
    ),
    (rolled(27, axis=2), "put the chief ray there"),
    (rolled(-27, axis=2), "put the chief ray there"),
    (rolled(27, axis=1), "put the chief ray there"),
    (rolled(-27, axis=1), "put the chief ray there"),
]


@pytest.mark.parametrize(("spoil", "words"), SPOILT, ids=[words for _, words in SPOILT])
def test_a_file_of_a_glass_that_was_changed_is_refused(tmp_path, spoil, words):
    assert words in changed(tmp_path, spoil)


def test_points_with_and_without_a_wavelength_are_no_glass():
    """One point of two images, so that each has its own place among the wavelengths."""
    plain = stack(1, (450.0, 650.0))
    at = plain.at.copy()
    at[1, 2] = np.nan
    line = refusal(glass_of, replace(plain, at=at))
    assert line.startswith("some points have a wavelength and others none")


def test_a_point_with_two_images_of_a_wavelength_is_no_glass():
    plain = stack(1, (450.0, 650.0, 650.0))
    line = refusal(glass_of, plain)
    assert "px has 2 images of 650 nm at focus 0 um; give each point one image of" in line


def test_more_images_than_a_glass_may_have_are_refused(monkeypatch):
    monkeypatch.setattr(psf_file, "MAX_IMAGES", 3)
    line = refusal(glass_of, stack(2, (550.0,)))
    assert line == "4 images; write 1 to 3"
    glass_of(stack(1, (450.0, 550.0, 650.0)))


@pytest.mark.parametrize(
    ("read", "text", "words"), REFUSED, ids=[words[:40] for _, _, words in REFUSED]
)
def test_what_is_no_lens_is_refused_in_one_line(read, text, words):
    line = refusal(read, text)
    assert re.search(words, line), line
