"""The tracker as a photometer: the light of the plan's codes, each on a lattice of dots that does not saturate it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.calibrate.first_light.lattice import field_for, peak_shares
from hilstar.calibrate.first_light.patterns import Pattern, black
from hilstar.calibrate.first_light.rooms import HOT_FILL, MAX_FILL, Room
from hilstar.calibrate.plan import Patch
from hilstar.errors import InputError
from hilstar.files import write_whole

FILL = 0.5  # of the tracker's range: what a lattice is chosen for
LESS = 4.0  # by which the exposure is shortened while white saturates
MAX_PROBES = 10
BLACK = Patch(0, "w")


@dataclass(frozen=True, slots=True)
class Link:
    """How much brighter a lit pixel is by its dense lattice than by its sparse one, both of one code: 1 where light adds up."""

    patch: Patch
    dense: int
    sparse: int
    ratio: float


@dataclass(frozen=True, slots=True)
class Readings:
    """Light (n,) of a lit pixel of each patch with the black level, DN/s, the exposure, and how lattices agree.

    `black_known` says that the black level was measured; else it is the bench file's share of white.
    """

    patches: list[Patch]
    light: FloatArray
    exposure_s: float
    links: list[Link]
    black_known: bool
    images: tuple[Path, ...]

    def write(self, path: Path) -> None:
        """MEASURED.csv, as `calibrate photometric` reads it. Raises InputError."""
        head = [f"# light of one monitor pixel in the tracker, DN/s, by dots on lattices; exposed for {self.exposure_s:.6g} s"]
        head += [
            f"# code {link.patch.code} of {link.patch.channel}: a pixel of every {link.dense} is {link.ratio:.5f} times"
            f" one of every {link.sparse}"
            for link in self.links
        ]
        rows = [
            f"{order},{patch.code},{patch.channel},{value!r}"
            for order, (patch, value) in enumerate(zip(self.patches, self.light.tolist(), strict=True), start=1)
        ]
        write_whole(path, "\n".join([*head, "order,code,channel,value", *rows]) + "\n")


@dataclass(frozen=True, slots=True)
class Assumed:
    """Light above black by channel and code (2^bits,), relative to white, and the black level: as the bench file has them."""

    light: dict[str, FloatArray]
    black: float


class Photometer:
    """Lattices before the tracker. Raises InputError where they cannot be seen whole."""

    def __init__(self, room: Room, sigma_px: float, assumed: Assumed) -> None:
        geometry = room.real_geometry()
        self.room, self.assumed = room, assumed
        self.field, self.periods = field_for(geometry, sigma_px)
        self.shares = peak_shares(self.periods, geometry.tracker.focal_length_px / geometry.monitor.focal_length_px, sigma_px)
        self.exposure_s = room.exposure_s
        self._dark_screen = room.take(Pattern("black_screen", black(room.resolution_px)))
        self.images = [self._dark_screen]
        self._cold = self._part(self._dark_screen) < HOT_FILL * room.full_dn

    def read(self, planned: list[Patch]) -> Readings:
        """Show the planned patches and read them. Raises InputError where the tracker cannot take white."""
        white_dn = self._expose()
        chosen = {patch: self._period(patch, white_dn) for patch in planned if patch.code}
        sums: list[float] = []
        for order, patch in enumerate(planned):
            while True:
                period = chosen.get(patch, 1)
                total, fill = self._look(f"patch_{order:03}_{period}", period, patch)
                if fill <= MAX_FILL or period == self.periods[-1]:
                    break
                chosen[patch] = 2 * period  # brighter than the bench file has it
            sums.append(total)
        links = [link for channel in self.assumed.light for link in self._links(channel, chosen)]
        light, black_known = self._light(planned, np.array(sums), chosen, links)
        return Readings(planned, light, self.exposure_s, links, black_known, tuple(self.images))

    def _expose(self) -> float:
        """Choose the exposure: the bench file's, or one in which white does not saturate; the peak of a white dot, DN."""
        white = self._brightest()
        for probe in range(MAX_PROBES):
            fill = self._look(f"white_{probe:02}", self.periods[-1], white)[1]
            if fill <= MAX_FILL:
                break
            if not self.room.eyes.sets_exposure:
                raise InputError(
                    f"one pixel at white saturates the tracker in {self.exposure_s:g} s: let --grab set the exposure"
                    " ({exposure_s}), turn the monitor's brightness down, or use a photometer (hilstar calibrate plan)"
                )
            self.exposure_s /= LESS
        else:
            raise InputError(f"one pixel at white saturates the tracker even in {self.exposure_s:.2g} s; look at stray light")
        if probe:
            self.exposure_s *= FILL / fill
        dark = self._part(self._take("black", 1, BLACK))
        bright = self._part(self._take("white", self.periods[-1], white))
        share = float(self.assumed.light[white.channel][white.code])
        return float((bright - dark)[self._cold].max(initial=1.0)) / share

    def _brightest(self) -> Patch:
        """White of the brightest channel."""
        return Patch(self.room.white, max(self.assumed.light, key=lambda name: float(self.assumed.light[name][-1])))

    def _period(self, patch: Patch, white_dn: float) -> int:
        """The densest lattice that a patch may have, by the response that the bench file assumes."""
        peaks = white_dn * self.assumed.light[patch.channel][patch.code] * self.shares / self.shares[-1]
        fits = np.flatnonzero(peaks <= FILL * self.room.full_dn)
        return self.periods[int(fits[0])] if len(fits) else self.periods[-1]

    def _links(self, channel: str, chosen: dict[Patch, int]) -> Iterator[Link]:
        """A code's dot by two lattices, for each two that follow each other in a channel."""
        periods = {patch: period for patch, period in chosen.items() if patch.channel == channel}
        dark = self._look(f"black_link_{channel}", 1, BLACK)[0]
        for dense, sparse in itertools.pairwise(sorted({*periods.values(), self.periods[-1]})):
            patch = max(patch for patch, period in periods.items() if period == dense)
            dots = [
                (self._look(f"link_{channel}_{sparse}_{period}", period, patch)[0] - dark) / self.field.lit(period)
                for period in (dense, sparse)
            ]
            if dots[1] <= 0:
                raise InputError(f"dots of code {patch.code} have no light in the tracker; look at what the screen shows")
            yield Link(patch, dense, sparse, dots[0] / dots[1])

    def _light(
        self, planned: list[Patch], sums: FloatArray, chosen: dict[Patch, int], links: list[Link]
    ) -> tuple[FloatArray, bool]:
        """Light (n,) of a pixel of each patch, black level included, DN/s, by the sparsest lattice; if black was measured."""
        order, dark = np.arange(len(planned)), np.array([patch.code == 0 for patch in planned])
        under = np.interp(order, order[dark], sums[dark])
        factor = {(channel, self.periods[-1]): 1.0 for channel in self.assumed.light}
        for link in reversed(links):
            channel = link.patch.channel
            factor[channel, link.dense] = factor[channel, link.sparse] * link.ratio
        periods = [chosen.get(patch, self.periods[-1]) for patch in planned]
        lit = [self.field.lit(p) * factor[patch.channel, p] for patch, p in zip(planned, periods, strict=True)]
        light = (sums - under) / (np.array(lit) * self.exposure_s)
        # Of a black screen each pixel has its light; its repeats tell how well it is known.
        light[dark] = (sums[dark] - sums[dark].mean()) / (self.field.monitor_px * self.exposure_s)
        glow = self._glow()
        if glow is not None:
            return np.maximum(light + glow, 0.0), True
        whites = [light[[patch == Patch(self.room.white, name) for patch in planned]].mean() for name in self.assumed.light]
        return np.maximum(light + self.assumed.black * float(np.sum(whites)), 0.0), False

    def _glow(self) -> float | None:
        """The light of a black pixel, DN/s: a black screen against one that is switched off, at the bench file's exposure."""
        unlit = self.room.unlit()
        if unlit is None:
            return None
        self.images.append(unlit)
        more = float((self._part(self._dark_screen) - self._part(unlit)).sum())
        return max(more / (self.field.monitor_px * self.room.exposure_s), 0.0)

    def _look(self, name: str, period: int, patch: Patch) -> tuple[float, float]:
        """The sum over the field of a lattice, DN, and how full its brightest pixel is."""
        part = self._part(self._take(name, period, patch))
        return float(part.sum()), float(part[self._cold].max(initial=0.0)) / self.room.full_dn

    def _take(self, name: str, period: int, patch: Patch) -> Path:
        pattern = Pattern(name, self.field.lattice(self.room.resolution_px, period, patch))
        self.images.append(self.room.take(pattern, self.exposure_s))
        return self.images[-1]

    def _part(self, path: Path) -> FloatArray:
        return self.room.read(path)[self.field.rows, self.field.columns]
