"""cedar-solve (a fork of ESA's tetra3) as a campaign's solver: from an image to w x y z of
q_icrs_to_cam.

Run by an environment that has it (pip install cedar-solve astropy): python cedar_solver.py
IMAGE.fits FOV_DEG
It finds stars 4 sigma above the background, by their centres of gravity, and knows nothing else of
the image.
"""

import sys

import numpy as np
import tetra3  # type: ignore[import-not-found]  # of another environment
from astropy.io import fits
from scipy import ndimage
from scipy.spatial.transform import Rotation

FIELD_ERROR_DEG = 0.5
STARS = 40


def centroids(image: np.ndarray) -> np.ndarray:
    """Centres of gravity (n, 2), row and column counted from the corner of the first pixel,
    brightest first.
    """
    light = image - np.median(image)
    noise = max(1.4826 * float(np.median(np.abs(light))), 0.5)
    labels, count = ndimage.label(light > 4 * noise, np.ones((3, 3)))
    numbers = np.arange(1, count + 1)
    order = numbers[np.argsort(-ndimage.sum(light, labels, numbers))][:STARS]
    return np.array(ndimage.center_of_mass(light, labels, order)).reshape(-1, 2) + 0.5


def q_icrs_to_cam(ra_deg: float, dec_deg: float, roll_deg: float) -> np.ndarray:
    """hilstar's convention (docs: Attitude in): R_icrs_from_cam = A3(ra - 90) A1(dec - 90)
    A3(roll), scalar first.
    """
    icrs_from_cam = Rotation.from_euler("ZXZ", [ra_deg - 90, dec_deg - 90, roll_deg], degrees=True)
    return icrs_from_cam.inv().as_quat()[[3, 0, 1, 2]]


image = fits.getdata(sys.argv[1]).astype(np.float64)
solution = tetra3.Tetra3().solve_from_centroids(
    centroids(image), image.shape, fov_estimate=float(sys.argv[2]), fov_max_error=FIELD_ERROR_DEG
)
if solution["RA"] is not None:
    print(*q_icrs_to_cam(solution["RA"], solution["Dec"], solution["Roll"]))
