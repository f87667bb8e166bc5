"""Where a spacecraft of Basilisk is and how fast, from a message: about the Earth, or against the origin of its frame N."""

from __future__ import annotations

import math

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.wire.packet import MAX_PLACE_KM, MAX_SPEED_KM_S, MIN_PLACE_KM, Refusal
from hilstar.attitude.wire.vizard.message import CelestialBody, Components, SimUpdate, Spacecraft
from hilstar.errors import printable, shortened

M_PER_KM = 1000.0
EARTHS = ("earth", "earth_planet_data")  # as gravBodyFactory and its SPICE messages name it


def velocity_km_s(craft: Spacecraft) -> FloatArray | Refusal:
    """The spacecraft's velocity (3,) against N's origin, or why it is not taken."""
    return _checked_velocity(craft, craft.velocity_m_s)


def state_about_earth(update: SimUpdate, craft: Spacecraft) -> tuple[FloatArray, FloatArray] | Refusal:
    """Place (3,), km, and velocity (3,), km/s, about the Earth's centre, or why they are not taken.

    The Earth is where the message has it; without one it stands at N's origin.
    """
    earth = next((body for body in update.bodies if body.name.lower() in EARTHS), CelestialBody())
    velocity = _checked_velocity(craft, _against(craft.velocity_m_s, earth.velocity_m_s))
    if isinstance(velocity, Refusal):
        return velocity
    place_m = _against(craft.position_m, earth.position_m)
    if len(place_m) == 3 and MIN_PLACE_KM < math.hypot(*place_m) / M_PER_KM < MAX_PLACE_KM:
        return np.array(place_m) / M_PER_KM, velocity
    told = f"{math.hypot(*place_m) / M_PER_KM:.4g} km from the Earth's centre" if place_m else "nowhere"
    advice = f'[spacecraft] orbit = "source" takes {MIN_PLACE_KM:g} to {MAX_PLACE_KM:g} km'
    return Refusal("format", f"spacecraft {named(craft)}: it is {told}, and {advice}")


def named(craft: Spacecraft) -> str:
    """A spacecraft's name for a person."""
    return shortened(printable(craft.name)) or "one without a name"


def _against(own: Components, other: Components) -> Components:
    return tuple(a - b for a, b in zip(own, other, strict=True)) if len(own) == len(other) == 3 else own


def _checked_velocity(craft: Spacecraft, found_m_s: Components) -> FloatArray | Refusal:
    speed_m_s = math.hypot(*found_m_s)
    if len(found_m_s) == 3 and speed_m_s <= MAX_SPEED_KM_S * M_PER_KM:
        return np.array(found_m_s) / M_PER_KM
    told = f"{speed_m_s:.3g} m/s" if found_m_s else "nothing"
    advice = f"it is {MAX_SPEED_KM_S:g} km/s at most; [attitude] use_velocity = false leaves it out"
    return Refusal("format", f"spacecraft {named(craft)}: its velocity is {told}, and {advice}")
