"""Small lens files, and an own trace of what is read from them: paraxial (y, nu) and by Snell's
law in vectors.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import astuple, is_dataclass

import numpy as np

# Sellmeier's coefficients by Schott's data sheets.
SCHOTT = {
    "N-BK7": ((1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653)),
    "N-F2": ((1.39757037, 0.159201403, 1.2686543), (0.00995906143, 0.0546931752, 119.248346)),
    "N-SF5": ((1.52481889, 0.187085527, 1.42729015), (0.011254756, 0.0588995392, 129.141675)),
}
# A cemented doublet of 100.031 mm, Edmund's 32-327: radius, thickness, glass.
DOUBLET = ((61.47, 6.0, "N-BK7"), (-44.64, 2.5, "N-SF5"), (-129.94, 95.952, ""))


def in_place_of(usual: list[str], lines: Iterable[str]) -> list[str]:
    """Usual lines, but for those whose keyword one of `lines` has, and then these."""
    lines = list(lines)
    keywords = {line.split()[0] for line in lines}
    return [line for line in usual if line.split()[0] not in keywords] + lines


def zmx(
    *system: str,
    surfaces=DOUBLET,
    more: dict[int, list[str]] | None = None,
    unit="MM",
    mm=1.0,
    far="INFINITY",
    behind=(),
) -> bytes:
    """The doublet as a .zmx file. `system` lines stand in place of ENPD's, `more` has lines of
    surfaces by their numbers.
    """
    head = system or (f"ENPD {20 / mm}",)
    usual = ["VERS 140124 258 36214", "MODE SEQ", f"UNIT {unit} X W X CM MR CPMM", "ENVD 20 1 0"]
    usual += ["GCAT SCHOTT", "FTYP 0 0 2 1 0 0 0", "XFLN 0 0", "YFLN 0 1"]
    usual += ["WAVM 1 0.5875618 1", "PWAV 1"]
    lines = in_place_of(usual, head)
    lines += ["SURF 0", "  TYPE STANDARD", '  CURV 0 0 0 0 0 ""', f"  DISZ {far}"]
    for number, (radius, thickness, glass) in enumerate(surfaces, 1):
        usual = ["  STOP"] if number == 1 else []
        usual += ["  TYPE STANDARD", f'  CURV {mm / radius!r} 0 0 0 0 ""']
        usual += [f"  DISZ {thickness / mm!r}"]
        usual += [f"  GLAS {glass} 0 0 1.5 40 0 0 0 0 0 0"] if glass else []
        lines += [f"SURF {number}", *in_place_of(usual, (more or {}).get(number, []))]
    lines += [
        f"SURF {len(surfaces) + 1}",
        "  TYPE STANDARD",
        '  CURV 0 0 0 0 0 ""',
        "  DISZ 0",
        *behind,
    ]
    return "\r\n".join(lines).encode()


def seq(
    *system: str, surfaces=DOUBLET, more: dict[int, list[str]] | None = None, mm=1.0, far="0.1e14"
) -> bytes:
    """The doublet as a .seq file. `system` lines come first; what they do not say is RDM, DIM M
    and EPD 20.
    """
    said = {line.split()[0].split(";")[0].upper() for line in system}
    lines = list(system)
    lines += [] if "RDM" in said else ["RDM;LEN"]
    lines += [] if "DIM" in said else ["DIM M"]
    lines += [] if said & {"EPD", "FNO", "NA", "NAO"} else [f"EPD {20 / mm!r}"]
    lines += [
        "WL 587.5618",
        "REF 1",
        *([] if "YAN" in said else ["XAN 0.0 0.0", "YAN 0.0 1.0"]),
        f"SO 0.0 {far}",
    ]
    for number, (radius, thickness, glass) in enumerate(surfaces, 1):
        name = f"{glass.replace('-', '')}_SCHOTT" if glass else ""
        lines += [
            f"S {radius / mm!r} {thickness / mm!r} {name}",
            *(["  STO"] if number == 1 else []),
        ]
        lines += (more or {}).get(number, [])
    return "\n".join([*lines, "SI 0.0 0.0", "GO"]).encode()


def numbers_of(part) -> list[float]:
    """Every number that a lens states, or a part of it: its lengths are mm."""
    if is_dataclass(part):
        part = astuple(part)
    if isinstance(part, (tuple, list, np.ndarray)):
        numbers: list[float] = []
        for inner in part:
            numbers += numbers_of(inner)
        return numbers
    return [] if part is None or isinstance(part, str) else [float(part)]


def index(glass, um: float) -> float:
    """A glass's index: by Schott's formula, or the lens file's own."""
    if glass.is_air:
        return 1.0
    if glass.index_d is not None:
        return float(glass.model_index(um))
    names = {name.replace("-", ""): name for name in SCHOTT}
    b, c = np.array(SCHOTT[names[glass.name.replace("-", "")]])
    return float(np.sqrt(1 + (b * um**2 / (um**2 - c)).sum()))


def focal_length_mm(lens) -> float:
    """The paraxial focal length of a centred lens at its primary wavelength: y, nu from surface
    to surface.
    """
    um = lens.wavelengths_um[lens.primary]
    y, nu, before = 1.0, 0.0, 1.0
    gaps = np.diff([surface.origin_mm[2] for surface in lens.surfaces])
    for surface, gap in zip(lens.surfaces[:-1], gaps, strict=True):
        after = -before if surface.glass.is_mirror else np.sign(before) * index(surface.glass, um)
        nu -= y * surface.paraxial_curvature_per_mm * (after - before)
        y += gap * nu / after
        before = after
    return -1 / nu


def real_rays(lens, at, along):
    """Places and directions (3, n) in the image's axes, and which rays pass all apertures:
    Newton, and Snell in vectors.
    """
    um = lens.wavelengths_um[lens.primary]
    passed = np.ones(at.shape[1], dtype=bool)
    before = 1.0
    for surface in lens.surfaces:
        at, along = surface.turn.T @ (at - surface.origin_mm[:, None]), surface.turn.T @ along
        far = -at[2] / along[2]
        for _ in range(12):  # Newton
            x, y, _z = at + along * far
            sag, slope_per_mm = _sag(surface, x * x + y * y)
            normal = np.stack([-slope_per_mm * x, -slope_per_mm * y, np.ones_like(x)])
            far = far - ((at + along * far)[2] - sag) / (normal * along).sum(axis=0)
        at, normal = at + along * far, normal / np.linalg.norm(normal, axis=0)
        for aperture in surface.apertures:
            passed &= aperture.passes(at[0], at[1])
        if surface is lens.surfaces[-1]:
            break
        cosine = (normal * along).sum(axis=0)
        if surface.glass.is_mirror:
            along = along - 2 * cosine * normal
        else:
            after = index(surface.glass, um)
            ratio = before / after
            side = np.sign(cosine)
            bent = np.sqrt(1 - ratio**2 * (1 - cosine**2))
            along, before = ratio * along + (side * bent - ratio * cosine) * normal, after
        at, along = surface.turn @ at + surface.origin_mm[:, None], surface.turn @ along
    return at, along, passed


def _sag(surface, r2):
    """The height of a surface, and its slope over the radius."""
    c = surface.curvature_per_mm
    root = np.sqrt(1 - (1 + surface.conic) * c * c * r2)
    sag, slope = c * r2 / (1 + root), c / root
    r = np.sqrt(r2)
    for power, term in enumerate(surface.polynomial, 1):
        sag = sag + term * r**power
        if term:
            slope = slope + power * term * r ** (power - 2)
    return sag, slope


def axial_bundle(lens, rays: int = 101):
    """Rays (3, n) of a star on the axis, evenly in a pupil of the lens's diameter, from before
    its first surface.
    """
    grid = np.array(np.meshgrid(*[(np.arange(rays) + 0.5) / rays * 2 - 1] * 2)).reshape(2, -1)
    inside = grid[:, (grid**2).sum(axis=0) <= 1] * lens.pupil / 2
    at = np.concatenate([inside, np.full((1, inside.shape[1]), -50.0)])
    return at, np.repeat([[0.0], [0.0], [1.0]], inside.shape[1], axis=1)


def rms_radius_um(lens) -> float:
    """The axial star's spot: the rms distance of its rays from their middle."""
    at, _, passed = real_rays(lens, *axial_bundle(lens))
    off = at[:2, passed] - at[:2, passed].mean(axis=1, keepdims=True)
    return float(np.sqrt((off**2).sum(axis=0).mean())) * 1e3


def lit_share(lens) -> float:
    """The share of an axial bundle that passes every aperture."""
    return float(real_rays(lens, *axial_bundle(lens, 160))[2].mean())
