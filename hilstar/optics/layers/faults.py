"""The faults that are on in one image: what they do to its view and to its light, and whether it
is shown at all.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import propagate, to_matrix
from hilstar.optics.extended import DiscLight, ExtendedLight, LightMap
from hilstar.optics.layers.fault_kinds import (
    AttitudeStep,
    Blank,
    Drop,
    Fault,
    Freeze,
    Now,
    StarGone,
)
from hilstar.optics.layers.fault_light import FaultView
from hilstar.optics.layers.star_layer import no_light
from hilstar.optics.layers.view import View
from hilstar.optics.sprites import AddedLight, FrameLight, with_sprites
from hilstar.sky.stars import BODY_CELL_RAD, CellGrid, Stars

NO_TURN = np.array([1.0, 0.0, 0.0, 0.0])
FRAME_SEED = 1  # beside the number of a frame


@dataclass(frozen=True, slots=True)
class FaultLayer:
    """The faults that are on in one image of one camera: the last layer."""

    view: FaultView
    now: tuple[Now, ...] = ()

    def _has(self, kind: type[Fault]) -> bool:
        return any(isinstance(active.fault, kind) for active in self.now)

    @property
    def blank(self) -> bool:
        """Whether there is no light at all."""
        return self._has(Blank)

    @property
    def frozen(self) -> bool:
        """Whether the last frame stays."""
        return self._has(Freeze)

    def drops(self, frame: int) -> bool:
        """Whether frame number `frame` is never shown."""
        for active in self.now:
            fault = active.fault
            if not isinstance(fault, Drop):
                continue
            if fault.share == 1:
                return True
            # by the frame's own number, so that a frame is dropped or not whoever asks
            if self.view.rng(fault.name, FRAME_SEED, frame).random() < fault.share:
                return True
        return False

    def turned(self, view: View) -> View:
        """The view that is shown in place of another: its attitude, and its rate in the axes of
        the camera as turned.
        """
        if not self._has(AttitudeStep):
            return view
        q = view.q_icrs_to_cam
        step = NO_TURN
        for active in self.now:
            if isinstance(active.fault, AttitudeStep):
                turn_rad = np.array(active.fault.turn_rad)
                q = propagate(q, turn_rad, 1.0)
                step = propagate(step, turn_rad, 1.0)
        rate = view.rate_cam_rad_s
        if rate is not None:
            rate = to_matrix(step) @ rate
        return replace(view, q_icrs_to_cam=q, rate_cam_rad_s=rate)

    def add(self, light: FrameLight, stars: Stars, view: View) -> FrameLight:
        """The light before without the stars that faults take away, and with the light that they
        add.
        """
        by = self.view
        now = self.now
        if self.blank:
            return replace(no_light(light.footprint_px), rate_cam_rad_s=light.rate_cam_rad_s)
        gone = by.gone(now, stars)
        if gone:
            removed = {}
            for active in now:
                if isinstance(active.fault, StarGone) and active.fault.star:
                    removed[active.fault.star] = 1 - active.share
            light = _without_discs(_dimmed(light, gone), removed)
        directions, named = by.sky_points(now, stars)
        chains, lines = by.camera_points(now, None if view.rate_cam_rad_s is None else view.scan)
        surfaces = by.surfaces(now, view.q_icrs_to_cam)
        parts = by.footprints(chains)
        if named:
            stars_of_faults = few_stars(directions, named, stars)
            drawn = by.by.points.add(no_light(light.footprint_px), stars_of_faults, view)
            # lines have -1, -2 and on for `star`, what is fixed on the sky the numbers after
            parts = [replace(drawn, star=-1 - len(lines) - drawn.star), *parts]
        if parts:
            per_star = light.per_star
            for part in parts:
                _, counts = np.unique(part.star, return_counts=True)
                per_star = max(per_star, part.per_star, int(counts.max(initial=1)))
            light = replace(with_sprites(light, parts), per_star=per_star, added=(*lines, *named))
        if surfaces:
            return replace(light, extended=(*light.extended, *surfaces))
        return light


def _dimmed(sprites: FrameLight, gone: list[tuple[int, float]]) -> FrameLight:
    """Sprites without some stars, or with a share of their light."""
    data = sprites.data
    is_shown = np.ones(len(sprites), dtype=bool)
    for star, remaining_share in gone:
        is_star = sprites.star == star
        if remaining_share <= 0:
            is_shown &= ~is_star
        elif is_star.any():
            data = data.copy()
            data["electrons_per_s"][is_star] *= np.float32(remaining_share)
    whole = replace(sprites, data=data)
    if is_shown.all():
        return whole
    return replace(
        whole,
        data=data[is_shown],
        star=sprites.star[is_shown],
        x_px=sprites.x_px[is_shown],
        y_px=sprites.y_px[is_shown],
    )


def _without_discs(sprites: FrameLight, gone: dict[str, float]) -> FrameLight:
    """Sprites whose discs of some bodies are dark, or have a share of their light; what they
    hide stays hidden.
    """
    if not any(name in gone for name in sprites.discs):
        return sprites
    lights: list[ExtendedLight] = []
    for light in sprites.extended:
        if isinstance(light, LightMap | DiscLight) and light.name in gone:
            light = replace(light, times=light.times * gone[light.name])
        lights.append(light)
    discs = tuple(name for name in sprites.discs if gone.get(name, 1.0) > 0)
    over_white = tuple(name for name in sprites.over_white if name in discs)
    return replace(sprites, extended=tuple(lights), discs=discs, over_white=over_white)


def few_stars(vectors: FloatArray, lights: Sequence[AddedLight], like: Stars) -> Stars:
    """Stars of a frame's own at ICRS directions (n, 3), for the observer of `like`."""
    count = len(lights)
    order = np.arange(count)
    grid = CellGrid(
        order=order,
        start=order,
        count=np.ones(count, dtype=np.intp),
        centre=vectors,
        cos_radius=np.full(count, np.cos(BODY_CELL_RAD)),
        sin_radius=np.full(count, np.sin(BODY_CELL_RAD)),
    )
    return Stars(
        hip=np.zeros(count, dtype=np.int32),
        vectors=vectors,
        v_mag=np.array([light.v_mag for light in lights]),
        bv_mag=np.array([light.bv_mag for light in lights]),
        temperature_k=np.full(count, np.nan),
        electrons_per_s=np.array([light.electrons_per_s for light in lights]),
        grid=grid,
        catalog=like.catalog,
        row=np.full(count, -1),
        velocity_km_s=like.velocity_km_s,
        bodies=tuple(light.name for light in lights),
    )
