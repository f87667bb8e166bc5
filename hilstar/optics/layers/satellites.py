"""Satellites in an image: each a streak along its path, a disc where it is wide enough to have a
face.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hilstar.optics.frame_motion import slowed
from hilstar.optics.layers.view import POINT_PX, Canvas, View
from hilstar.optics.sprites import FrameLight
from hilstar.optics.trails import (
    EVERY,
    Brush,
    Lit,
    TrailView,
    disc_of,
    disc_trail,
    hidden,
    trails,
    wide,
    with_trails,
)
from hilstar.sky.stars import Stars

if TYPE_CHECKING:
    from hilstar.sky.bodies.disc import Disc
    from hilstar.sky.bodies.moving import MovingSky
    from hilstar.sky.bodies.passes import Pass, Satellites

# Limits of the work: sprites of all satellites together in a frame (the cost of 60 stars' paths of
# 16 px) and in an exposure, and poses of one disc.
FRAME_SPRITES, EXPOSURE_SPRITES = 1000, 200_000
# discs along a satellite's path: they bound the work of an image
FRAME_POSES, EXPOSURE_POSES = 33, 500
ROW_ROUNDS = 2  # as for stars: see `scene.frame_motion`


@dataclass(frozen=True, slots=True)
class SatelliteLayer:
    """The satellites of a sky of at least `faintest_e_per_s` in an image."""

    moving: "MovingSky"
    canvas: Canvas
    faintest_e_per_s: float = 0.0

    def add(self, light: FrameLight, stars: Stars, view: View) -> FrameLight:
        """The light before and that of the satellites in the image, which are written into the
        arrays of `stars`.
        """
        canvas = self.canvas
        satellites = self.moving.satellites
        rows = view.rows
        turn = view.turn
        if not view.exposed:
            turn, _ = slowed(turn, view.scan, canvas.camera)
        # between the moment of the attitude and any light: an exposure begins by half of it before
        longest_s = rows.longest_s
        margin_px = canvas.psf.footprint_px / 2 + 1
        reach_rad = canvas.camera.field_radius_rad(margin_px) + turn.speed_rad_s * longest_s
        passing = self._passing(view, reach_rad, longest_s)
        if passing is None or satellites is None:
            return light
        icrs_to_image = view.icrs_to_image(canvas.camera)
        path = TrailView(
            canvas.camera,
            icrs_to_image,
            canvas.camera.cam_to_image @ turn.rate_cam_rad_s,
            stars.velocity_km_s,
        )
        close = path.in_reach(passing, longest_s, margin_px)
        if not len(close):
            return light
        passing = passing.only(close)
        brush = self._brush(view)
        if satellites.sized:
            broad = wide(passing, canvas.camera.scales_px_rad()[1], POINT_PX)
            if broad.any():
                wide_ones = passing.only(np.flatnonzero(broad))
                light = self._with_discs(light, stars, wide_ones, path, view)
                passing = passing.only(np.flatnonzero(~broad))
        drawn_trails = trails(
            passing, path, self._lit(passing, path, view), brush, self.faintest_e_per_s
        )
        if not len(drawn_trails.index):
            return light
        satellites.write(
            stars, drawn_trails.index, drawn_trails.middle, drawn_trails.electrons_per_s
        )
        return with_trails(light, drawn_trails, len(stars) - len(stars.bodies))

    def discs(self, stars: Stars, view: View) -> "list[Disc]":
        """The satellites in the image of a camera at rest that are discs."""
        satellites = self.moving.satellites
        if satellites is None or not satellites.sized:
            return []
        camera = self.canvas.camera
        reach_rad = camera.field_radius_rad(0.0)
        passing = self._passing(view, reach_rad, 0.0, faintest_e_per_s=0.0)
        if passing is None:
            return []
        _, largest_px_rad = camera.scales_px_rad()
        discs = []
        for k in np.flatnonzero(wide(passing, largest_px_rad, POINT_PX)).tolist():
            name = satellites.names[passing.index[k]]
            satellite = passing.only(np.array([k]))
            discs.append(disc_of(satellite, name, 0.0, stars.velocity_km_s))
        return discs

    def _passing(
        self, view: View, reach_rad: float, longest_s: float, faintest_e_per_s: float | None = None
    ) -> "Pass | None":
        """The satellites that may be within `reach_rad` of the boresight; None for none."""
        from hilstar.sky.bodies.passes import Cone  # imports SGP4, which only satellites need

        axis = view.icrs_to_image(self.canvas.camera)[2]
        faintest = self.faintest_e_per_s if faintest_e_per_s is None else faintest_e_per_s
        return self.moving.passing(Cone(axis, reach_rad, longest_s, faintest), *view.observer)

    def _brush(self, view: View) -> Brush:
        """The bounds of an exposure's work, or of a frame's."""
        if view.exposed:
            return Brush(self.canvas.psf, EXPOSURE_SPRITES, EXPOSURE_POSES)
        return Brush(self.canvas.psf, FRAME_SPRITES, FRAME_POSES)

    def _lit(self, seen: "Pass", path: TrailView, view: View) -> Lit:
        """When each satellite's row is lit."""
        rows = view.rows
        late_s = np.zeros(len(seen))
        for _ in range(ROW_ROUNDS if rows.scanout_s else 0):
            x_px, y_px = path.places_px(seen, EVERY, late_s)
            late_s = np.nan_to_num(rows.late_s(x_px, y_px, self.canvas.camera.resolution_px))
        return Lit(view.begin_s + late_s, rows.hold_s)

    def _with_discs(
        self, light: FrameLight, stars: Stars, seen: "Pass", path: TrailView, view: View
    ) -> FrameLight:
        """The light before with satellites as discs, the farthest first, and without what they
        hide.
        """
        satellites: Satellites | None = self.moving.satellites
        if satellites is None:
            return light
        lit = self._lit(seen, path, view)
        drawn = []
        farthest_first = np.argsort(-np.linalg.norm(seen.seen_km[0], axis=1))
        for k in farthest_first:
            lit_span = Lit(lit.begin_s[[k]], lit.length_s)
            name = satellites.names[seen.index[k]]
            trail = disc_trail(seen.only(np.array([k])), name, path, lit_span, self._brush(view))
            if trail is not None:
                drawn.append(trail)
                light = hidden(light, stars.directions(light.star), trail)
        index = np.array([trail.index for trail in drawn], dtype=np.intp)
        rates = np.array([trail.electrons_per_s for trail in drawn])
        middles = np.array([trail.middle for trail in drawn]).reshape(-1, 3)
        satellites.write(stars, index, middles, rates)
        white_e_per_s = self.canvas.white_in(view)
        lights = list(light.extended)
        discs = list(light.discs)
        over_white = list(light.over_white)
        for trail in drawn:
            name = trail.along[0].name
            lights.extend(trail.lights)
            discs.append(name)
            if trail.brightest_e_per_s > white_e_per_s:
                over_white.append(name)
        return replace(
            light, extended=tuple(lights), discs=tuple(discs), over_white=tuple(over_white)
        )
