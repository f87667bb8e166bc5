"""The layer of a bench's stars, and the light of no layer, on which all begin."""

from dataclasses import dataclass, field, replace
from functools import cache

from hilstar.optics.exposure_motion import MIDDLE_S, smeared_sprites
from hilstar.optics.frame_motion import swept_sprites
from hilstar.optics.layers.view import Canvas, View
from hilstar.optics.sprites import Candidates, FrameLight, join_sprites, make_sprites, with_sprites
from hilstar.sky.stars import Stars


@cache
def no_light(footprint_px: int) -> FrameLight:
    """The light of no layer."""
    return join_sprites([], footprint_px)


@dataclass(frozen=True, slots=True)
class StarLayer:
    """Stars: points where the camera is at rest or without `paths`, otherwise each along its path
    while light arrives.

    The stars `frequent` are drawn in most frames: those near the field are kept from one frame to
    the next.
    """

    canvas: Canvas
    frequent: Stars | None = None
    paths: bool = True
    candidates: Candidates = field(default_factory=Candidates, repr=False)

    def add(self, light: FrameLight, stars: Stars, view: View) -> FrameLight:
        """The light before, with a sprite or a chain of sprites for each star on the image."""
        canvas = self.canvas
        camera = self.canvas.camera
        if self.paths and view.exposed and view.rate_cam_rad_s is not None:
            made = smeared_sprites(stars, view.motion, camera, canvas.psf, view.scan)
        elif self.paths and view.turns and not view.exposed:
            made = swept_sprites(stars, view.turn, view.scan, camera, canvas.psf)
            made = replace(made, rate_cam_rad_s=view.rate_cam_rad_s)
        else:
            if view.exposed:
                icrs_to_image = view.motion.icrs_to_image(MIDDLE_S, camera)[0]
            else:
                icrs_to_image = view.icrs_to_image(camera)
            if stars is self.frequent:
                candidates = self.candidates
            else:
                candidates = None
            made = make_sprites(stars, icrs_to_image, camera, canvas.psf.footprint_px, candidates)
        if light.extended or len(light.data):
            return with_sprites(light, [made])
        return made
