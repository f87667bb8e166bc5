"""Make blue-noise.npy, the threshold mask of `dither` and `temporal`: `python
tools/make_blue_noise.py`.

Void and cluster (R. Ulichney, Proc. SPIE 1913, 1993). All energies are whole numbers, so every
machine makes the same file.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from hilstar.display.quantise import MASK_FILE

SIDE = 64
SIGMA_PX = 1.5  # Ulichney's choice
SEED = 1993
FIRST_SHARE = 0.1  # share of pixels that are ones in the first pattern
UNIT = 2**40  # energies are counted in 1 / UNIT: 4096 of them stay under 2^63

Ranks = npt.NDArray[np.uint16]


class Pattern:
    """A binary pattern on a torus and the energy that its ones spread."""

    def __init__(self) -> None:
        away = np.minimum(np.arange(SIDE), SIDE - np.arange(SIDE))
        near = np.exp(-(away**2) / (2 * SIGMA_PX**2))
        self._spread = np.rint(np.outer(near, near) * UNIT).astype(np.int64)
        self.ones = np.zeros((SIDE, SIDE), dtype=bool)
        self._energy = np.zeros((SIDE, SIDE), dtype=np.int64)

    def flip(self, place: int) -> None:
        """Turn a one to a zero, or back."""
        row, column = divmod(place, SIDE)
        sign = -1 if self.ones[row, column] else 1
        self.ones[row, column] ^= True
        self._energy += sign * np.roll(self._spread, (row, column), axis=(0, 1))

    def tightest_cluster(self) -> int:
        """The one with the most ones about it."""
        return int(np.where(self.ones, self._energy, -1).argmax())

    def largest_void(self) -> int:
        """The zero with the fewest ones about it."""
        return int(np.where(self.ones, np.iinfo(np.int64).max, self._energy).argmin())


def void_and_cluster(rng: np.random.Generator) -> Ranks:
    """Ranks 0 to SIDE^2 - 1, each once, shape (SIDE, SIDE): those under any rank are spread
    evenly, with no low frequencies.
    """
    first = rng.choice(SIDE**2, round(FIRST_SHARE * SIDE**2), replace=False)
    pattern = Pattern()
    for place in first:
        pattern.flip(int(place))
    while True:
        cluster = pattern.tightest_cluster()
        pattern.flip(cluster)
        void = pattern.largest_void()
        pattern.flip(void)
        if void == cluster:
            break
    start = np.flatnonzero(pattern.ones)
    ranks = np.zeros(SIDE**2, dtype=np.uint16)
    for rank in range(len(start) - 1, -1, -1):
        cluster = pattern.tightest_cluster()
        pattern.flip(cluster)
        ranks[cluster] = rank
    for place in start:
        pattern.flip(int(place))
    # The largest void among the few ones and the tightest cluster among the many zeros are one
    # place: energies add up to a constant. So one rule fills both halves.
    for rank in range(len(start), SIDE**2):
        void = pattern.largest_void()
        pattern.flip(void)
        ranks[void] = rank
    return ranks.reshape(SIDE, SIDE)


def main() -> None:
    """Write the packaged mask."""
    np.save(MASK_FILE, void_and_cluster(np.random.default_rng(SEED)))


if __name__ == "__main__":
    main()
