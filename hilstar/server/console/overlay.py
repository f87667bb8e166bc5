"""Computes the marks that the page draws over a picture: star labels, the tracker's outline, and
the grid of right ascension and declination, from the bench's stars and its two cameras.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
from msgspec import UNSET

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import direction_of, from_rotation_vector, to_matrix, to_radec_roll_deg
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.display.primaries import PRIMARIES
from hilstar.display.render.aids import AidLevels
from hilstar.optics.camera import Camera
from hilstar.server.bench.cameras import tracker_camera
from hilstar.server.console.protocol import GridLine, SkyMap, SkyPlace, StarMark, Truth
from hilstar.sky.catalog import label_of, load_catalog, star_names
from hilstar.sky.stars import Stars

if TYPE_CHECKING:
    from hilstar.server.bench.frame import Bench

MAX_STARS, MAX_COLOURS = 400, 5000  # marked stars of a picture; stars with a note on their colour
SKY_FAINTEST_MAG = 5.5
SIDE_PLACES = 9  # points on each side of the tracker's outline: a lens bends the sides
LINE_PLACES = 49  # points on a line of the grid
LINES_ACROSS = 3  # minimum number of grid lines from the image's middle to its corner
STEPS_DEG = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 30.0)
RA_STEPS_DEG = (*STEPS_DEG, 45.0, 90.0)
BEYOND = 0.1  # lines extend so far outside the image, relative to its size
PX_DIGITS, SKY_DIGITS = 2, 4


class AnswerMarks(NamedTuple):
    """A tracker's answer on the monitor: the outline of the field that it reports, and its
    centroids, lists of (x, y), monitor px.
    """

    field_px: list[list[float]]
    centroids_px: list[list[float]]


@dataclass(frozen=True, slots=True)
class CameraMarks:
    """The marks that need no stars: boresight, outline of the tracker's field, and lines of RA and
    Dec, computed with the two cameras of a bench.
    """

    monitor: Camera
    tracker: Camera

    def truth(
        self,
        frame: int,
        stars: list[StarMark],
        q_icrs_to_cam: FloatArray | None,
        grid: bool = False,
    ) -> Truth:
        """All marks of a picture: the given stars, boresight and outline, and, with `grid` and an
        attitude, the lines of RA and Dec.
        """
        lines: list[GridLine] = []
        if grid and q_icrs_to_cam is not None:
            lines = list(
                self._grid(q_icrs_to_cam, self.monitor.cam_to_image @ to_matrix(q_icrs_to_cam))
            )
        return Truth(
            frame=frame,
            stars=stars,
            boresight_px=[round(at, PX_DIGITS) for at in self.monitor.boresight_px],
            tracker_px=self._on_monitor(
                self.tracker.rays(*_border(self.tracker.resolution_px, SIDE_PLACES))
            ),
            grid=lines if grid else UNSET,
        )

    def answer(
        self,
        residual_arcsec: list[float] | None,
        lit: FloatArray,
        shown: FloatArray,
        centroids: list[tuple[float, float]],
    ) -> AnswerMarks:
        """The marks of a tracker's answer in a picture of the attitude `shown`: the field that the
        tracker reports and its `centroids`, tracker px.

        `residual_arcsec` (3,) is the answer's, None without one. `lit` is the attitude that the
        answer was compared with: the stars have moved since, so that the centroids move with them.
        """
        field_px: list[list[float]] = []
        if residual_arcsec is not None:
            # The reported attitude is E C: the field's rays, taken back by E, stand where the
            # tracker says in the shown sky.
            error = to_matrix(from_rotation_vector(np.array(residual_arcsec) / ARCSEC_PER_RAD))
            field_px = self._on_monitor(
                self.tracker.rays(*_border(self.tracker.resolution_px, SIDE_PLACES)) @ error
            )
        places = np.array(centroids).reshape(-1, 2)
        moved = to_matrix(shown) @ to_matrix(lit).T
        return AnswerMarks(
            field_px, self._on_monitor(self.tracker.rays(places[:, 0], places[:, 1]) @ moved.T)
        )

    def _on_monitor(self, rays: FloatArray) -> list[list[float]]:
        """The positions (x, y), monitor px, of rays (n, 3), camera axes; rays without a position
        on the monitor's plane are left out.
        """
        x_px, y_px = self.monitor.project_outward(rays @ self.monitor.cam_to_image.T)
        known = np.isfinite(x_px) & np.isfinite(y_px)
        return [[x, y] for x, y in np.column_stack((x_px, y_px))[known].round(PX_DIGITS).tolist()]

    def on_screen(self, x_px: FloatArray, y_px: FloatArray, beyond: float) -> np.ndarray[Any, Any]:
        """Whether positions (n,), px, lie on the monitor or outside it by at most `beyond` times
        its size.
        """
        width, height = self.monitor.resolution_px
        with np.errstate(invalid="ignore"):  # NaN: behind the camera, or beyond the lens
            inside = np.abs(x_px - (width - 1) / 2) <= width * (0.5 + beyond)
            return np.asarray(inside & (np.abs(y_px - (height - 1) / 2) <= height * (0.5 + beyond)))

    def _grid(self, q_icrs_to_cam: FloatArray, turn: FloatArray) -> Iterator[GridLine]:
        """The lines of RA and Dec in the field; `turn` (3, 3) turns ICRS into image axes."""
        ra_deg, dec_deg, _ = to_radec_roll_deg(q_icrs_to_cam)
        radius_deg = math.degrees(self.monitor.field_radius_rad(0.0))
        step_deg = _step(STEPS_DEG, radius_deg / LINES_ACROSS)
        low_deg = max(dec_deg - radius_deg, -90.0)
        high_deg = min(dec_deg + radius_deg, 90.0)
        wide_deg = 180.0
        ra_step_deg = 30.0
        # How far in right ascension the field reaches; all around where it contains a pole.
        if max(-low_deg, high_deg) < 90.0:
            share = math.sin(math.radians(min(radius_deg, 89.0))) / math.cos(math.radians(dec_deg))
            wide_deg = math.degrees(math.asin(min(share, 1.0)))
            ra_step_deg = _step(RA_STEPS_DEG, wide_deg / LINES_ACROSS)
        reach = np.linspace(-wide_deg, wide_deg, LINE_PLACES * (4 if wide_deg > 90 else 1))
        for dec in _multiples(low_deg, high_deg, step_deg):
            label = f"Dec {dec:+.{_digits(step_deg)}f}\N{DEGREE SIGN}"
            yield from self._line(label, ra_deg + reach, np.full_like(reach, dec), turn)
        up = np.linspace(low_deg, high_deg, LINE_PLACES)
        for ra in _multiples(ra_deg - wide_deg, ra_deg + wide_deg - 1e-9, ra_step_deg):
            yield from self._line(
                f"RA {ra % 360:.{_digits(ra_step_deg)}f}\N{DEGREE SIGN}",
                np.full_like(up, ra),
                up,
                turn,
            )

    def _line(
        self, label: str, ra_deg: FloatArray, dec_deg: FloatArray, turn: FloatArray
    ) -> Iterator[GridLine]:
        x_px, y_px = self.monitor.project(direction_of(ra_deg, dec_deg) @ turn.T)
        inside = self.on_screen(x_px, y_px, BEYOND)
        # A piece extends one point beyond the image's edge on each side; a single point is no line.
        near = np.isfinite(x_px) & (
            inside | np.append(inside[1:], False) | np.append(False, inside[:-1])
        )
        bounds = np.flatnonzero(np.diff(np.concatenate(([False], near, [False])).astype(np.int8)))
        for begin, end in zip(bounds[::2], bounds[1::2], strict=True):
            if end - begin > 1:
                places = np.column_stack((x_px[begin:end], y_px[begin:end]))
                yield GridLine(label.replace("-", "\N{MINUS SIGN}"), places.round(1).tolist())


@dataclass(frozen=True, slots=True)
class Overlay:
    """The marks of a bench: those of its two cameras, and its stars that are bright enough for the
    monitor.
    """

    marks: CameraMarks
    stars: Stars

    @property
    def monitor(self) -> Camera:
        """The monitor's camera."""
        return self.marks.monitor

    def sky(self) -> SkyMap:
        """The map of the whole sky: stars and bodies brighter than SKY_FAINTEST_MAG, the brightest
        first, and the directions of the screen's corners, camera axes.
        """
        bodies = len(self.stars.bodies)
        order = np.argsort(self.stars.v_mag, kind="stable")
        bright = order[self.stars.v_mag[order] < SKY_FAINTEST_MAG]
        is_body = bright >= len(self.stars) - bodies
        rays = self.monitor.rays(*_border(self.monitor.resolution_px, 2))
        known = np.isfinite(rays).all()
        if known:
            corners = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        else:
            corners = rays[:0]
        return SkyMap(
            self._places(bright[~is_body]),
            self._places(bright[is_body]),
            np.round(corners, 6).tolist(),
        )

    def _places(self, which: np.ndarray[Any, Any]) -> list[SkyPlace]:
        x, y, z = self.stars.directions(which).T
        ra_deg = np.degrees(np.arctan2(y, x)) % 360.0
        dec_deg = np.degrees(np.arctan2(z, np.hypot(x, y)))
        v_mag = self.stars.v_mag[which].round(2).tolist()
        places = ra_deg.round(SKY_DIGITS).tolist(), dec_deg.round(SKY_DIGITS).tolist()
        return [SkyPlace(*row) for row in zip(*places, v_mag, self._labels(which, ""), strict=True)]

    def _labels(self, which: np.ndarray[Any, Any], none: str | None = None) -> list[str]:
        """The labels of stars: a body's name, else the star's designation, else its HIP number, or
        `none` in place of the number if that is given.
        """
        found = zip(self.stars.names(which), self.stars.hip[which].tolist(), strict=True)
        labels = [name or label_of(hip) for name, hip in found]
        if none is None:
            return labels
        return [none if label.startswith("HIP ") else label for label in labels]

    def truth(
        self, frame: int, q_icrs_to_cam: FloatArray, clipped: tuple[int | str, ...] = ()
    ) -> Truth:
        """All marks of a picture at an attitude, with its MAX_STARS brightest stars and the grid.
        `clipped` are the HIP numbers of clipped stars, and names of those without one.
        """
        turn = self.monitor.cam_to_image @ to_matrix(q_icrs_to_cam)
        near = self.stars.near(turn[2], self.monitor.field_radius_rad(0.0))
        x_px, y_px = self.monitor.project(self.stars.directions(near) @ turn.T)
        inside = np.flatnonzero(self.marks.on_screen(x_px, y_px, 0.0))
        inside = inside[np.argsort(self.stars.v_mag[near[inside]], kind="stable")][:MAX_STARS]
        which = near[inside]
        marked = set(clipped)
        hips = self.stars.hip[which].tolist()
        names = self.stars.names(which)
        columns = (
            x_px[inside].round(PX_DIGITS).tolist(),
            y_px[inside].round(PX_DIGITS).tolist(),
            self.stars.v_mag[which].round(2).tolist(),
            hips,
            self._labels(which),
            [int((name or hip) in marked) for name, hip in zip(names, hips, strict=True)],
        )
        stars = [StarMark(*row) for row in zip(*columns, strict=True)]
        return self.marks.truth(frame, stars, q_icrs_to_cam, grid=True)


def overlay_of(bench: "Bench") -> Overlay:
    """The overlay of an open bench."""
    return Overlay(
        CameraMarks(bench.camera, tracker_camera(bench.config.tracker, bench.file.folder)),
        bench.shown_stars,
    )


def catalogue_sky() -> SkyMap:
    """The map of the sky without a bench: the bright stars of Hipparcos at their catalogue
    positions (epoch 1991.25).
    """
    catalog = load_catalog()
    bright = np.argsort(catalog.v_mag, kind="stable")
    bright = bright[catalog.v_mag[bright] < SKY_FAINTEST_MAG]
    columns = (catalog.ra_deg[bright], catalog.dec_deg[bright], catalog.v_mag[bright])
    rows = zip(
        *(column.round(SKY_DIGITS).tolist() for column in columns),
        catalog.hip[bright].tolist(),
        strict=True,
    )
    return SkyMap(
        [
            SkyPlace(ra, dec, v_mag, star_names().get(hip, ("", ""))[0])
            for ra, dec, v_mag, hip in rows
        ]
    )


def _border(resolution_px: tuple[int, int], places: int) -> tuple[FloatArray, FloatArray]:
    """Points around the edge of an image in order, x and y, px: `places` on each side, its corners
    included.
    """
    width, height = resolution_px
    along = np.linspace(0.0, 1.0, places)[:-1]
    share_x = np.concatenate((along, np.ones_like(along), 1 - along, np.zeros_like(along)))
    share_y = np.concatenate((np.zeros_like(along), along, np.ones_like(along), 1 - along))
    return share_x * width - 0.5, share_y * height - 0.5


def _step(steps: tuple[float, ...], most: float) -> float:
    """The largest of `steps` (rising) that is not above `most`, else the smallest."""
    return max((step for step in steps if step <= most), default=steps[0])


def _multiples(low: float, high: float, step: float) -> list[float]:
    """The multiples of `step` from `low` to `high`, ends included in spite of rounding."""
    return [
        k * step for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    ]


def _digits(step_deg: float) -> int:
    if step_deg >= 1:
        return 0
    if step_deg >= 0.1:
        return 1
    return 2


@dataclass(frozen=True, eq=False)
class OverlayScene:
    """What the page's process needs to draw over a bench's pictures, in a form that can be pickled.

    `hip` and `v_mag` (n,) belong to the bench's shown stars. `names` are the names of stars without
    a HIP number, by index, and `sky` is the map of the whole sky. `aids_in_levels` says that the
    levels of a picture contain the operator's aids already. `colours` are the notes of
    `colour_notes`.
    """

    marks: CameraMarks
    hip: npt.NDArray[np.int32]
    v_mag: npt.NDArray[np.float32]
    names: dict[int, str]
    sky: SkyMap
    aids: AidLevels
    aids_in_levels: bool
    colours: dict[int, str]

    def label(self, star: int) -> str:
        """The text beside the star of that index."""
        return self.names.get(star) or label_of(int(self.hip[star]))


def colour_notes(bench: "Bench") -> dict[int, str]:
    """A note on the colour of each of the MAX_COLOURS brightest stars, by the star's index: the
    shares of the tracker's channels, or the mean wavelength for a tracker without channels.
    {} where the monitor's primaries are not driven separately.
    """
    colours = bench.colours
    stars = bench.shown_stars
    if colours is None:
        return {}
    which = np.argsort(stars.v_mag[: len(stars.rates_e_per_s)], kind="stable")[:MAX_COLOURS]
    wanted = colours.wanted(stars, which)
    shares = colours.shares_of(stars, which)
    notes = []
    for own_shares, shown in zip(wanted.tolist(), colours.shown(shares).tolist(), strict=True):
        if colours.mono:
            notes.append(
                f"{own_shares[0]:.0f} nm"
                + ("" if abs(own_shares[0] - shown[0]) < 1 else f", shown {shown[0]:.0f} nm")
            )
        else:
            notes.append(
                " ".join(
                    f"{name} {share:.0%}" for name, share in zip(PRIMARIES, own_shares, strict=True)
                )
            )
    reached = colours.in_gamut(colours.off(wanted, shares)).tolist()
    said = (
        note if inside else f"{note}, out of gamut"
        for note, inside in zip(notes, reached, strict=True)
    )
    return dict(zip(which.tolist(), said, strict=True))
