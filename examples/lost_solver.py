"""LOST (UWCubeSat) as a campaign's solver: from a picture to w x y z of q_icrs_to_cam.

python lost_solver.py LOST_FOLDER IMAGE.png FOV_DEG, where LOST_FOLDER has the program and a
database, made once with
./lost database --max-stars 5000 --kvector --kvector-min-distance 0.2 --kvector-max-distance 15 \\
    --kvector-distance-bins 10000 --output stars.dat
"""

import subprocess
import sys

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

folder, picture, fov_deg = sys.argv[1:]
# LOST reads 8 bits, and takes noise for stars: what is under 5 sigma of the background is black.
dn = np.array(Image.open(picture)).astype(np.float64)
light = dn - np.median(dn)
light[light < 5 * max(1.4826 * np.median(np.abs(light)), 0.5)] = 0.0
stretched = np.clip(light / max(np.percentile(light, 99.97), 1.0) * 255, 0, 255)
Image.fromarray(stretched.astype(np.uint8)).save(picture + ".8.png")
words = [
    "./lost",
    "pipeline",
    "--png",
    picture + ".8.png",
    "--fov",
    fov_deg,
    "--database",
    "stars.dat",
]
words += [
    "--centroid-algo",
    "cog",
    "--centroid-filter-brightest",
    "20",
    "--star-id-algo",
    "py",
    "--angular-tolerance",
    "0.05",
]
words += [
    "--false-stars",
    "1000",
    "--max-mismatch-prob",
    "0.0001",
    "--attitude-algo",
    "dqm",
    "--print-attitude",
    "-",
]
said = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=True).stdout
found = dict(line.split(maxsplit=1) for line in said.splitlines() if line.startswith("attitude_"))
if found.get("attitude_known") == "1":
    ra_deg, dec_deg, roll_deg = (float(found[f"attitude_{name}"]) for name in ("ra", "de", "roll"))
    # LOST's roll turns north to the right of up, hilstar's to the left.
    icrs_from_cam = Rotation.from_euler("ZXZ", [ra_deg - 90, dec_deg - 90, -roll_deg], degrees=True)
    print(*icrs_from_cam.inv().as_quat()[[3, 0, 1, 2]])
