"""What a solver says of one image."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class CentroidErrors:
    """Centroids of one image against the truth: counts, and x and y errors (n,), px, measured minus
    true, of matched stars.

    `stars` are on the detector, `matched` of them were found within MATCH_PX, and `false` finds
    belong to no star. Errors are those of stars that are neither clipped, nor at the edge, nor
    crowded; `v_mag` (n,) are their magnitudes, `star` their rows.
    """

    stars: int
    found: int
    matched: int
    false: int
    dx_px: FloatArray
    dy_px: FloatArray
    v_mag: FloatArray
    star: npt.NDArray[np.void]


@dataclass(frozen=True, slots=True)
class SolverAnswer:
    """An attitude, or None and the reason; from the centroider also the centroids' errors."""

    q_icrs_to_cam: FloatArray | None
    why: str = ""
    star_errors: CentroidErrors | None = None
