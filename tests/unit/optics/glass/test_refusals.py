"""Lens files that are refused: what is written, and the words of the one line that says so."""

from __future__ import annotations

import re

import pytest

from hilstar.optics.glass.codev_file import read_codev
from hilstar.optics.glass.zemax_file import read_zemax
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
        zmx_surface("USAP lens.uda"),
        r"line \d+: USAP at surface 1 is an aperture of a shape of its own",
    ),
    (zmx_surface("PKUP 2"), r"line \d+: PKUP at surface 1 takes its aperture from another surface"),
    (
        zmx_surface("SCBD 1 0 0 0 0 90 0 0"),
        r"line \d+: SCBD at surface 1 tilts or moves the surface",
    ),
    (
        zmx_surface("XDAT 1 3.0 0 0 1 0 0"),
        r"line \d+: XDAT at surface 1 gives further coefficients",
    ),
    (zmx_surface("PARM 2 1e-5"), r"line \d+: PARM 2 of surface 1 \(STANDARD\) is not known"),
    (zmx_surface("FRNL 3 4"), r"line \d+: FRNL at surface 1 is not known"),
    # not indented, as an operand of the merit function
    (zmx(more={1: ["FRNL 3 4 5 6 7 8 9"]}), r"line \d+: FRNL at surface 1 is not known"),
    (zmx_surface("CLAP 0 0 0"), r"line \d+: CLAP at surface 1 has no size"),
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
]
CODEV = [
    (seq("DIM F"), "DIM is F; write M"),
    (
        seq("RDM").replace(b"RDM\n", b""),
        r"surface 1 \(line \d+\) has 61.47, which without RDM is a curvature.*write RDM Y",
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
]
REFUSED = [
    *((read_zemax, text, words) for text, words in ZEMAX),
    *((read_codev, text, words) for text, words in CODEV),
]


@pytest.mark.parametrize(
    ("read", "text", "words"), REFUSED, ids=[words[:40] for _, _, words in REFUSED]
)
def test_what_is_no_lens_is_refused_in_one_line(read, text, words):
    line = refusal(read, text)
    assert re.search(words, line), line
