"""The light of a view: stars, then diffuse light, bodies, then satellites, then faults."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from hilstar.optics.layers.bodies import BodyLayer
from hilstar.optics.layers.star_layer import StarLayer, no_light
from hilstar.optics.layers.view import Canvas, Layer, View
from hilstar.optics.sprites import FrameLight
from hilstar.sky.stars import Stars

if TYPE_CHECKING:
    from hilstar.sky.bodies.moving import MovingSky
    from hilstar.sky.diffuse import TangentImage


@dataclass(frozen=True, slots=True)
class Sources:
    """The light of a bench's sky beside its stars.

    That is bodies, satellites and the observer (`moving`, None where the sky stands still), and
    `diffuse` light, e-/s/sr.
    """

    moving: "MovingSky | None" = None
    diffuse: "tuple[TangentImage, ...]" = ()


NO_SOURCES = Sources()


def seen_in(view: View, stars: Stars, moving: "MovingSky | None") -> Stars:
    """A bench's stars as a view has them; bodies are moved to their places in the arrays of
    `stars`.
    """
    return (
        stars.seen_at(view.velocity_km_s) if moving is None else moving.seen(stars, *view.observer)
    )


def sky_layers(
    canvas: Canvas,
    sources: Sources = NO_SOURCES,
    faintest_e_per_s: float = 0.0,
    frequent: Stars | None = None,
    *,
    paths: bool = True,
) -> tuple[Layer, ...]:
    """The layers of the sky: a bench's stars, diffuse light, bodies, and satellites of at least
    `faintest_e_per_s`.

    For `frequent` and `paths` see `StarLayer`.
    """
    layers: list[Layer] = [StarLayer(canvas, frequent, paths)]
    if sources.diffuse:
        # its libraries take 30 ms, which only a map needs
        from hilstar.optics.layers.diffuse_layer import DiffuseLayer

        layers.append(DiffuseLayer(sources.diffuse, canvas))
    moving = sources.moving
    if moving is not None and moving.names:
        layers.append(BodyLayer(moving, canvas))
    if moving is not None and moving.satellites is not None:
        from hilstar.optics.layers.satellites import SatelliteLayer

        layers.append(SatelliteLayer(moving, canvas, faintest_e_per_s))
    return tuple(layers)


def light_of(canvas: Canvas, layers: Iterable[Layer], stars: Stars, view: View) -> FrameLight:
    """The light of a view, layer by layer; `stars` are as seen in it (see `seen_in`)."""
    light = no_light(canvas.psf.footprint_px)
    for layer in layers:
        light = layer.add(light, stars, view)
    return light
