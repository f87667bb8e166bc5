"""What the faults of one frame do to it: attitude, sprites, and whether it is shown at all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.faults.desk import Now
from hilstar.bench.faults.kinds import AttitudeStep, Blank, Drop, Fault, Freeze
from hilstar.bench.faults.view import FaultView
from hilstar.rotation import propagate, to_matrix
from hilstar.scene.extended import DiscLight, LightMap
from hilstar.scene.frame_motion import Scan
from hilstar.scene.sprites import AddedLight, Sprites, join_sprites
from hilstar.sky.stars import BODY_CELL_RAD, CellGrid, Stars

NO_TURN = np.array([1.0, 0.0, 0.0, 0.0])
FRAME_SEED = 1  # beside the number of a frame


@dataclass(frozen=True, slots=True)
class Effects:
    """The faults that are on in one frame, for one camera."""

    view: FaultView
    now: tuple[Now, ...] = ()

    def _has(self, kind: type[Fault]) -> bool:
        return any(isinstance(one.fault, kind) for one in self.now)

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
        return any(
            one.fault.share == 1 or self.view.rng(one.fault.name, FRAME_SEED, frame).random() < one.fault.share
            for one in self.now
            if isinstance(one.fault, Drop)
        )

    def turned(self, q_icrs_to_cam: FloatArray) -> FloatArray:
        """The attitude that is shown in place of `q_icrs_to_cam`."""
        for one in self.now:
            if isinstance(one.fault, AttitudeStep):
                q_icrs_to_cam = propagate(q_icrs_to_cam, np.array(one.fault.turn_rad), 1.0)
        return q_icrs_to_cam

    def turned_rate(self, rate_cam_rad_s: FloatArray) -> FloatArray:
        """A rate in the axes of the camera as it is shown."""
        return to_matrix(self.turned(NO_TURN)) @ rate_cam_rad_s if self._has(AttitudeStep) else rate_cam_rad_s

    def over(
        self,
        sprites: Sprites,
        stars: Stars,
        q_icrs_to_cam: FloatArray,
        draw: Callable[[Stars], Sprites],
        scan: Scan | None = None,
    ) -> Sprites:
        """A frame's sprites with its faults; without them they are `sprites` of `stars` as seen, at that attitude.

        `draw` makes the sprites of other stars in the same way; `scan` is how the image lights up, None where stars are points.
        """
        view, now = self.view, self.now
        if self.blank:
            return replace(join_sprites([], sprites.footprint_px), rate_cam_rad_s=sprites.rate_cam_rad_s)
        gone = view.gone(now, stars)
        if gone:
            sprites = _without_discs(_dimmed(sprites, gone), view.gone_bodies(now))
        directions, named = view.sky_points(now, stars)
        chains, lines = view.camera_points(now, scan)
        surfaces = view.surfaces(now, q_icrs_to_cam)
        parts = view.footprints(chains)
        if named:
            drawn = draw(few_stars(directions, named, stars))
            parts = [replace(drawn, star=-1 - len(lines) - drawn.star), *parts]
        if parts:
            joined = join_sprites([sprites, *parts], sprites.footprint_px)
            per_star = max(sprites.per_star, *(_most_per_star(part) for part in parts))
            sprites = replace(
                sprites,
                data=joined.data,
                star=joined.star,
                x_px=joined.x_px,
                y_px=joined.y_px,
                per_star=per_star,
                added=(*lines, *named),
            )
        return replace(sprites, extended=(*sprites.extended, *surfaces)) if surfaces else sprites


def _most_per_star(part: Sprites) -> int:
    return max(part.per_star, int(np.unique(part.star, return_counts=True)[1].max(initial=1)))


def _dimmed(sprites: Sprites, gone: list[tuple[int, float]]) -> Sprites:
    """Sprites without some stars, or with a share of their light."""
    data, kept = sprites.data, np.ones(len(sprites), dtype=bool)
    for star, left in gone:
        its = sprites.star == star
        if left <= 0:
            kept &= ~its
        elif its.any():
            data = data.copy()
            data["electrons_per_s"][its] *= np.float32(left)
    whole = replace(sprites, data=data)
    if kept.all():
        return whole
    return replace(whole, data=data[kept], star=sprites.star[kept], x_px=sprites.x_px[kept], y_px=sprites.y_px[kept])


def _without_discs(sprites: Sprites, gone: dict[str, float]) -> Sprites:
    """Sprites whose discs of some bodies are dark, or have a share of their light; what they hide stays hidden."""
    if not any(name in gone for name in sprites.discs):
        return sprites
    lights = tuple(
        replace(light, times=light.times * gone[light.name])
        if isinstance(light, LightMap | DiscLight) and light.name in gone
        else light
        for light in sprites.extended
    )
    discs = tuple(name for name in sprites.discs if gone.get(name, 1.0) > 0)
    return replace(sprites, extended=lights, discs=discs, over_white=tuple(n for n in sprites.over_white if n in discs))


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
