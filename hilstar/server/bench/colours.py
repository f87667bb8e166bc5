"""What a bench mixes its primaries for, star by star: with each channel's electrons, or the nearest
spectrum of one channel.

Three channels: the mixture has the star's electrons in each, or is the nearest in electrons
(non-negative least squares).

One channel has one number of electrons, and three primaries to make it of. The mixture is the one
with the star's own mean wavelength of detected photons, so that lateral colour acts as in the sky;
of those, the one whose cumulative spectrum of detected photons is nearest to the star's (Cramer's
distance, which is finite for the lines of a laser too). Its sum is held. Of a lens whose lateral
colour is known, that comes first: see `Lateral`.
Both ask the same of a star: its electrons through some curves of wavelength, which the tables of
its rates give.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray, with_columns
from hilstar.basics.errors import InputError
from hilstar.display.primaries import PRIMARIES, ChannelMatrix, channel_matrix, nearest_mixtures
from hilstar.optics.extended import shifted
from hilstar.optics.glass.glass_psf import GlassPsf, NodeSpline
from hilstar.optics.psf import Psf
from hilstar.optics.sprites import FrameLight, extended_by_share, shares_at, shares_of_sprites
from hilstar.sky.catalog import Catalog
from hilstar.sky.electrons import Optics, all_channels
from hilstar.sky.spectrum import Curve, blackbody_exitance_w_m2_m, integration_nodes
from hilstar.sky.stars import BV_MAG, Stars

STEP_NM = 0.25  # in the spectra of primaries
KNOT_STEPS = 8
MEAN_WEIGHT = 1e3  # per nm: a mean wavelength within reach is met to 1e-3 nm
# times that, of a lens's lateral colour against as much of the mean wavelength
LATERAL_WEIGHT = 1e3
LEAST_PX, LEAST_PART = 1e-5, 1e-2  # lateral colour, and its first part, that counts
# stars by colour, and a square px of all against one of those that are out of reach
ASIDE_STARS, ASIDE_COST = 500, 1e-3
MOVED = 1 + len(PRIMARIES)  # the first column of what is wanted that is a lens's
UNSEEN = 1e-6  # share of white
# electrons per second: a primary that a star has nothing of is chosen with the others all the same
TINY = 1e-30
# Within the gamut: of a star's electrons, of its mean wavelength, and of its place through a lens
WITHIN, WITHIN_NM, WITHIN_PX = 1e-6, 0.1, 1e-4
SCALE_K = np.geomspace(1500.0, 60_000.0, 400)

# The electrons (n,) of stars of V = 0, B-V (n,), V-I (n,) and types through some optics.
RatesBy = Callable[[Optics], Callable[..., FloatArray]]


@dataclass(frozen=True, slots=True)
class Lateral:
    """A lens's lateral colour: by how much wavelengths `nm` (L,) move light, px rms over the field,
    in parts `px` (L, k).

    All stars together may be shown `aside` (k,) of their places, by a pattern over the field that
    is the same for all, as a distortion is: then more of what parts them is within the primaries'
    reach. `by_primary` (3, k) is a primary's, and `weight` that of a square px.
    """

    nm: FloatArray
    px: FloatArray
    by_primary: FloatArray
    aside: FloatArray
    weight: float

    @classmethod
    def of(cls, psf: GlassPsf, nm: FloatArray, density: FloatArray) -> "Lateral | None":
        """That of a glass to the primaries' light; None where it moves none of it by LEAST_PX."""
        moved = psf.moved_px - psf.moved_px.mean(axis=1, keepdims=True)
        by_wavelength = moved.transpose(0, 2, 1).reshape(-1, moved.shape[1])
        rms = by_wavelength / np.sqrt(len(moved))  # over the field's places
        _, size, parts = np.linalg.svd(rms, full_matrices=False)
        min_size = max(LEAST_PX, LEAST_PART * size[0])
        px = (parts.T * size)[:, size > min_size]
        splines = NodeSpline(psf.wavelengths_nm)
        by_primary = density @ splines(nm) @ px
        spread = _square_spread(by_primary)
        if spread < LEAST_PX**2:
            return None
        weight = LATERAL_WEIGHT * MEAN_WEIGHT * _square_spread(density @ nm) / spread
        return cls(psf.wavelengths_nm, px, by_primary, np.zeros(px.shape[1]), weight)

    @property
    def lifted(self) -> FloatArray:
        """A constant (k,), px, that is added to the lens's curves before stars' means are taken of
        them, so that none is below 0.
        """
        return np.asarray(2 * np.abs(self.px).max(axis=0))  # a spline passes its nodes by less


def _square_spread(by_primary: FloatArray) -> float:
    """The sum of the squares of primaries' (3,) or (3, k) departures from their mean."""
    departure = by_primary - by_primary.mean(axis=0)
    return float(np.square(departure).sum())


@dataclass(frozen=True, slots=True)
class Colours:
    """The primaries of a bench's monitor before its tracker.

    `matrix` is that of a white of 1 electron per second, `of_white` (3,) each primary's share of
    that, and `by_primary` (channels, 3) each channel's share of the electrons of a primary.
    `places_px` (3, 2) is where a primary's light lies within a pixel of the image. `density` (3, n)
    are the spectra of the photons that the tracker detects of each, of
    sum 1, at `nm` (n,).
    """

    matrix: ChannelMatrix
    places_px: FloatArray
    nm: FloatArray
    density: FloatArray
    _gram: FloatArray
    _curves: tuple[Callable[..., FloatArray], ...]
    _kinds: FloatArray | None
    _scale: FloatArray
    lateral: Lateral | None = None
    # the last frame's extended light, and each primary's of it
    _kept: list[Any] = field(default_factory=list)

    @property
    def of_white(self) -> FloatArray:
        """Each primary's share of white (3,), in electrons of all channels."""
        return np.asarray(self.matrix.e_per_s.sum(axis=0))

    @property
    def mean_nm(self) -> FloatArray:
        """The mean wavelength (3,) of the photons that the tracker detects of each primary."""
        return np.asarray(self.density @ self.nm)

    @property
    def by_primary(self) -> FloatArray:
        """Each channel's share (channels, 3) of the electrons of a primary."""
        return np.asarray(self.matrix.e_per_s / self.of_white)

    @property
    def mono(self) -> bool:
        """Whether the tracker has one channel."""
        return len(self.matrix.channels) == 1

    def wanted(self, stars: Stars, which: IntArray | None = None) -> FloatArray:
        """What the mixture of primaries of each star should have.

        Shares of channels (n, channels); or of a mono tracker means over the star's photons (n, 4 +
        k): wavelength, products of the cumulative spectrum with the primaries', and displacements
        by the lens. Bodies are taken by their B-V.
        """
        if which is None:
            which = np.arange(len(stars))
        if stars.colours is not None:
            return np.asarray(stars.colours[which])
        row = stars.row[which]
        listed = row >= 0
        catalogue_row = np.maximum(row, 0)
        vi = np.full(len(which), np.nan)
        if len(stars.catalog):
            vi = np.where(listed, stars.catalog.vi_mag[catalogue_row], np.nan)
        kind = None
        if self._kinds is not None:
            kind = np.where(listed[:, None], self._kinds[catalogue_row], np.nan)
        return self._means(stars.bv_mag[which], vi, kind)

    def _means(self, bv_mag: FloatArray, vi_mag: FloatArray, kind: FloatArray | None) -> FloatArray:
        v_mag = np.zeros(len(bv_mag))
        photons, *weighted = [curve(v_mag, bv_mag, vi_mag, kind) for curve in self._curves]
        means = np.stack(weighted, axis=1) / photons[:, None]
        if self.lateral is not None:
            means[:, MOVED:] -= self.lateral.lifted
        return np.asarray(means)

    def for_stars(self, catalog: Catalog) -> "Colours":
        """The same colours with the common displacement (`Lateral.aside`) by which mixtures of
        primaries come nearest, rms, to what a catalogue's stars want.

        A lens parts stars by colour, and primaries cannot part them as far: what all stars have in
        common is free, as a distortion is.
        """
        if self.lateral is None or not len(catalog):
            return self
        from scipy.optimize import minimize  # 0.2 s of every command that needs none of it

        every = math.ceil(len(catalog) / ASIDE_STARS)
        some = np.argsort(catalog.bv_mag)[::every]
        kind = None
        if self._kinds is not None:
            kind = self._kinds[some]
        wanted = self._means(catalog.bv_mag[some], catalog.vi_mag[some], kind)
        lens = self.lateral
        size_px = float(np.abs(lens.px).max())

        # the mean square of what is out of reach, and its gradient
        def cost(aside: FloatArray) -> tuple[float, FloatArray]:
            moved = replace(lens, aside=aside * size_px)
            shares = replace(self, lateral=moved).shares(wanted)
            rest_px = shares @ lens.by_primary - wanted[:, MOVED:] - moved.aside
            rest = rest_px / size_px
            square = np.square(rest).sum(axis=1).mean() + ASIDE_COST * aside @ aside
            gradient = 2 * (ASIDE_COST * aside - rest_px.mean(axis=0) / size_px)
            return float(square), gradient

        nearest = minimize(cost, lens.aside, jac=True, method="BFGS", options={"gtol": 1e-6})
        return replace(self, lateral=replace(lens, aside=nearest.x * size_px))

    def shares(self, wanted: FloatArray) -> FloatArray:
        """The light of each primary (n, 3) for what is `wanted`, as shares of a star's
        electrons.
        """
        if not self.mono:
            return nearest_mixtures(self._gram, wanted @ self.by_primary)
        # The normal equations of the cumulative spectrum, of the mean wavelength and of the place.
        middle_nm = self.mean_nm.mean()
        away = self.mean_nm - middle_nm
        wanted_away = wanted[:, :1] - middle_nm
        gram = self._gram + MEAN_WEIGHT * np.outer(away, away)
        near = wanted[:, 1:MOVED] + MEAN_WEIGHT * wanted_away * away
        lens = self.lateral
        if lens is not None:
            place_px = wanted[:, MOVED:] + lens.aside
            gram = gram + lens.weight * lens.by_primary @ lens.by_primary.T
            near = near + lens.weight * place_px @ lens.by_primary.T
        mixtures = nearest_mixtures(gram, near, whole=True)
        return np.asarray(mixtures / mixtures.sum(axis=1, keepdims=True))  # to 1e-11

    def on(self, stars: Stars) -> Stars:
        """The stars with the light of each primary."""
        primaries, by_bv = self._shares_of_all(stars)
        return replace(stars, primaries=primaries, primaries_by_bv=by_bv)

    def _shares_of_all(self, stars: Stars) -> tuple[FloatArray, FloatArray]:
        """The light of each primary of every star, and of light of the colours BV_MAG."""
        if stars.primaries is not None and stars.primaries_by_bv is not None:
            return stars.primaries, stars.primaries_by_bv
        by_bv = stars.colours_by_bv
        if by_bv is None:
            unknown = np.full_like(BV_MAG, np.nan)
            kind = None
            if self._kinds is not None:
                kind = np.full((len(BV_MAG), 2), np.nan)
            by_bv = self._means(BV_MAG, unknown, kind)
        return self.shares(self.wanted(stars)), self.shares(by_bv)

    def drive(self, shares: FloatArray) -> FloatArray:
        """How much of white stars of so much light of each primary (n, 3) ask for, relative to a
        white star, (n,).
        """
        return np.asarray((shares / self.of_white).max(axis=1))

    def shown(self, shares: FloatArray) -> FloatArray:
        """What mixtures of primaries (n, 3) have of what is `wanted`: shares of channels (n,
        channels), or the mean wavelength (n, 1), nm.
        """
        if self.mono:
            return np.asarray(shares @ self.mean_nm[:, None])
        return np.asarray(shares @ self.by_primary.T)

    def off(self, wanted: FloatArray, shares: FloatArray) -> FloatArray:
        """How far off mixtures are (n,): the share of a star's electrons in the wrong channel, or
        the mean wavelength's nm.

        Before a lens of known lateral colour, px rms over the field.
        """
        lens = self.lateral
        if lens is not None:
            off_px = shares @ lens.by_primary - wanted[:, MOVED:] - lens.aside
            return np.asarray(np.linalg.norm(off_px, axis=1))
        shown = self.shown(shares)
        difference = shown - wanted[:, : shown.shape[1]]
        return np.asarray(np.abs(difference).sum(axis=1))

    def in_gamut(self, off: FloatArray) -> BoolArray:
        """Whether stars that are so far `off` have their colour."""
        if not self.mono:
            tolerance = WITHIN
        elif self.lateral is None:
            tolerance = WITHIN_NM
        else:
            tolerance = WITHIN_PX
        return np.asarray(off < tolerance)

    def temperature_factor(self, wanted: FloatArray, shares: FloatArray) -> FloatArray:
        """The colour temperatures of mixtures (n,) over those of their stars, by black bodies of
        the same colour.

        The colour is blue's electrons over red's, or the mean wavelength.
        """
        shown_k = np.interp(warmth(self.shown(shares)), self._scale, SCALE_K)
        wanted_k = np.interp(warmth(wanted), self._scale, SCALE_K)
        return np.asarray(shown_k / wanted_k)

    def shares_of(self, stars: Stars, star: IntArray) -> FloatArray:
        """The light of each primary (n, 3) of stars at places (n,) of a bench's; below 0, where
        light is none's, their mean.
        """
        return shares_at(self._shares_of_all(stars)[0], stars, star)

    def on_truth(
        self, truth: npt.NDArray[np.void], stars: Stars, star: IntArray
    ) -> npt.NDArray[np.void]:
        """Rows of TRUTH_DTYPE with what is shown of stars at places (n,): temperature, electrons by
        channel, and how far off.

        `off_gamut` is the share of electrons in the wrong channel; of one channel the mean
        wavelengths wanted and shown stand for it. Light that is no star's has NaN.
        """
        star_rows = np.flatnonzero(star >= 0)
        wanted = self.wanted(stars, star[star_rows])
        shares = self.shares_of(stars, star[star_rows])
        shown = self.shown(shares)
        off = self.off(wanted, shares)
        in_gamut = self.in_gamut(off)
        rate = truth["electrons_per_s"][star_rows]
        factor = self.temperature_factor(wanted, shares)
        added = {"temperature_shown_k": truth["temperature_k"][star_rows] * factor}
        if self.mono:
            added["wavelength_nm"] = wanted[:, 0]
            added["wavelength_shown_nm"] = shown[:, 0]
            added["electrons_shown_per_s"] = rate * shares.sum(axis=1)
        else:
            for name, by_channel in (("electrons", wanted), ("electrons_shown", shown)):
                for k, channel in enumerate(PRIMARIES):
                    added[f"{name}_{channel}_per_s"] = rate * by_channel[:, k]
            added["off_gamut"] = np.where(in_gamut, 0.0, off)
        return with_columns(truth, added | {"in_gamut": in_gamut}, star_rows)

    def driven(self, sprites: FrameLight, stars: Stars) -> FrameLight:
        """Sprites with the light of each primary; `sprites.star` has places among `stars`."""
        primaries, by_bv = self._shares_of_all(stars)
        shares = shares_of_sprites(sprites, stars, primaries, by_bv)
        rate = sprites.data["electrons_per_s"][:, None]
        light = np.maximum(rate * shares, TINY).astype(np.float32)
        if not sprites.extended:
            return replace(sprites, primaries=light)
        # the same objects are the same light: it is moved once
        if not self._kept or self._kept[0] != sprites.extended:
            by_primary = extended_by_share(sprites, stars, primaries, by_bv)
            moved = []
            for lights, (x_px, y_px) in zip(by_primary, self.places_px.tolist(), strict=True):
                moved.append(tuple(shifted(part, -x_px, -y_px) for part in lights))
            self._kept[:] = [sprites.extended, tuple(moved)]
        return replace(sprites, primaries=light, lights=self._kept[1])


def warmth(colour: FloatArray) -> FloatArray:
    """A number that rises with temperature, of shares of channels (n, 3) or means (n, 1 or
    more).
    """
    if colour.shape[1] != len(PRIMARIES):
        return -colour[:, 0]
    tiny = np.finfo(np.float64).tiny
    red = np.maximum(colour[:, 0], tiny)
    blue = np.maximum(colour[:, -1], tiny)
    return np.asarray(np.log(blue) - np.log(red))


def mixed_for(
    primaries: tuple[Curve, ...],
    channels: dict[str, Optics],
    places_px: npt.ArrayLike,
    rates_by: RatesBy,
    kinds: FloatArray | None = None,
    psf: Psf | None = None,
) -> Colours:
    """The colours of a monitor's primaries before a tracker of these channels, and a lens with a
    `psf`.

    `kinds` (catalogue, 2) are the types by which `rates_by` counts, if it does. Raises InputError
    where the tracker sees nothing of a primary.
    """
    matrix = channel_matrix(primaries, channels, 1.0)
    of_white = matrix.e_per_s.sum(axis=0)
    unseen = [name for name, share in zip(PRIMARIES, of_white, strict=True) if share < UNSEEN]
    if unseen:
        raise InputError(
            '[render] colour = "star": the tracker sees nothing of the primary'
            f' {", ".join(unseen)}; write colour = "white"'
        )
    optics = all_channels(list(channels.values()))
    nm = np.arange(optics.range_nm[0], optics.range_nm[1] + STEP_NM, STEP_NM)
    response = optics.quantum_efficiency(nm) * optics.transmission(nm)
    density = np.array([curve(nm) for curve in primaries]) * (response * nm)
    density /= density.sum(axis=1, keepdims=True)
    places = np.asarray(places_px)
    scale = _scale(channels)
    if len(channels) > 1:
        by_primary = matrix.e_per_s / of_white
        gram = by_primary.T @ by_primary
        return Colours(matrix, places, nm, density, gram, (), kinds, scale)
    up_to = np.cumsum(density, axis=1)
    gram = up_to @ up_to.T * STEP_NM
    lateral = None
    if isinstance(psf, GlassPsf):
        lateral = Lateral.of(psf, nm, density)
    efficiency = optics.quantum_efficiency
    knots = _knots(optics, nm)
    curves = []
    for weight in _weights(knots, nm, up_to, lateral):
        weighted = Curve(knots, efficiency(knots) * weight)
        curves.append(rates_by(replace(optics, quantum_efficiency=weighted)))
    return Colours(matrix, places, nm, density, gram, tuple(curves), kinds, scale, lateral)


def _knots(optics: Optics, nm: FloatArray) -> FloatArray:
    """Wavelengths (k,), nm, at which a weighted quantum efficiency is given: some of `nm`, and the
    curve's own.
    """
    own_nm = optics.quantum_efficiency.wavelength_nm
    if not len(own_nm):  # the same at each wavelength
        own_nm = np.array(optics.range_nm)
    knots = nm[::KNOT_STEPS]
    inside = (knots > own_nm[0]) & (knots < own_nm[-1])
    return np.unique(np.concatenate([knots[inside], own_nm]))


def _weights(
    knots: FloatArray, nm: FloatArray, up_to: FloatArray, lateral: Lateral | None
) -> list[FloatArray]:
    """The weights (k,) at `knots` whose means over a star's photons `Colours.wanted` has, after
    that of the photons themselves.

    `up_to` (3, n) are the primaries' cumulative spectra at `nm` (n,).
    """
    # The part of a cumulative spectrum above a wavelength: a photon there adds as much to a star's
    # product with it.
    above = np.cumsum(up_to[:, ::-1], axis=1)[:, ::-1] * STEP_NM
    weights = [np.ones_like(knots), knots]
    for curve in above:
        weights.append(np.interp(knots, nm, curve))
    if lateral is not None:
        splines = NodeSpline(lateral.nm)
        moved_px = splines(knots) @ lateral.px + lateral.lifted
        weights.extend(moved_px.T)
    return weights


def _scale(channels: dict[str, Optics]) -> FloatArray:
    """The rising index of black bodies of SCALE_K."""
    by_channel = len(channels) > 1
    scales = []
    for optics in channels.values():
        efficiency = optics.quantum_efficiency
        transmission = optics.transmission
        nm, weight = integration_nodes(efficiency, transmission)
        exitance = blackbody_exitance_w_m2_m(nm, SCALE_K[:, None])
        photons = exitance * nm * efficiency(nm) * transmission(nm) * weight
        if by_channel:
            scales.append(photons.sum(axis=1))
        else:
            scales.append(photons @ nm / photons.sum(axis=1))
    return np.maximum.accumulate(warmth(np.stack(scales, axis=1)))
