"""[background]."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from hilstar.bench.config.values import Magnitude, NotNegative, Signed
from hilstar.toml_tables import Table


class Background(Table, frozen=True):
    """Light between the stars. Only the virtual tracker sees it; the monitor shows none.

    Give at most one of the first two keys.
    """

    electrons_per_px: Annotated[
        NotNegative | None,
        Meta(description="Electrons that the background makes in each tracker pixel per exposure.", extra={"default": "`0`"}),
    ] = None
    zodiacal_v_mag_arcsec2: Annotated[
        Magnitude | None,
        Meta(
            description="Surface brightness of sunlight through the tracker's optics; the thesis takes 22.1.",
            extra={"default": "none"},
        ),
    ] = None
    gradient_electrons_across: Annotated[
        tuple[Signed, Signed],
        Meta(
            description="By how many electrons per exposure the background grows from one edge of the detector to the other.",
            extra={"form": "[right, down]"},
        ),
    ] = (0.0, 0.0)
