"""Stellarium (GPL, Debian's package): places of stars, planets and the Moon from a site, and their
magnitudes.

A script of Stellarium's own tells what it has of each object: geometric altitudes and azimuths, of
the date, from the site, without air. It runs under Xvfb.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from astropy.time import Time
from astropy.utils import iers

from hilstar.attitude.logs.earth import q_icrs_to_enu
from hilstar.basics.arrays import BoolArray, FloatArray
from hilstar.basics.charts import two_digits
from hilstar.basics.errors import MachineError
from hilstar.basics.rotation import rotate
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.server.bench.bench_file import bench_file_of
from hilstar.server.bench.star_light import bench_sources, bench_stars
from hilstar.sky.catalog import load_catalog
from tests.support.benches import bench_text
from tests.support.beside.steps import Beside, Step

PROGRAM, DISPLAY = "stellarium", "xvfb-run"
LATITUDE_DEG, LONGITUDE_DEG, HEIGHT_M = 45.5, 9.2, 1200.0
NOW, J2000 = "2026-11-21T22:00:00", "2000-01-01T12:00:00"
STARS, BRIGHT_V_MAG, LOWEST = 120, 5.0, 0.1
ANSWERED_WITHIN_S = 300.0
# Of a Hipparcos number that is a pair's Stellarium tells one star: the same where both are as bright.
SAME_MAG, MAG_STEP = 0.1, 0.05
EARTH_ARCSEC_S = 15.041067  # how fast the Earth turns
HIPPARCOS_YEARS = 2000.0 - 1991.25
STAR_PLACES, BODY_PLACES = "places of stars", "places of the Moon and planets"
SCRIPT = """core.setTimeRate(0);
core.setObserverLocation({longitude}, {latitude}, {height}, 0, "Beside", "Earth");
core.setDate("{utc}", "utc", false);
core.setTimeRate(0);
core.wait(1);
var names = [{names}];
for (var i = 0; i < names.length; i++) {{
  var told = core.getObjectInfo(names[i]);
  core.output("<" + names[i] + "|" + told["altitude-geometric"] + "|" + told["azimuth-geometric"]
    + "|" + told["vmag"] + ">");
}}
core.quitStellarium();
"""


@dataclass(frozen=True, slots=True)
class SeenSky:
    """Objects (n,) on a date: names, hilstar's and Stellarium's directions (n, 3), east, north and
    up, and magnitudes; and which are bodies.
    """

    names: list[str]
    ours: FloatArray
    theirs: FloatArray
    our_mag: FloatArray
    their_mag: FloatArray
    is_body: BoolArray
    utc: str
    q_icrs_to_enu: FloatArray

    @property
    def same_star(self) -> BoolArray:
        """Stars that are as bright in both."""
        return ~self.is_body & (np.abs(self.our_mag - self.their_mag) < SAME_MAG)


def run(folder: Path, *, quick: bool = False) -> Beside:
    """Two dates of one site. Raises MachineError without Stellarium."""
    if shutil.which(PROGRAM) is None or shutil.which(DISPLAY) is None:
        raise MachineError("stellarium is not installed; apt-get install stellarium xvfb xauth")
    now, then = seen_sky(folder, NOW), seen_sky(folder, J2000)
    its_now, its_then = as_utc(now), as_utc(then)
    steps = []
    for step, sky, which in (
        ("as both come, 2026", now, ~now.is_body),
        ("stars as bright in both: no companions", now, now.same_star),
        ("with UTC for UT1, as it has it", its_now, now.same_star),
        ("in 2000: no proper motion yet", its_then, then.same_star),
        ("some at their places of 1991.25", at_hipparcos_epoch(its_then), then.same_star),
    ):
        steps.append(Step(STAR_PLACES, "arcsec, rms an axis", step, rms_arcsec(sky, which)))
    inner = now.is_body & ~np.isin(now.names, ["Moon", "Uranus", "Neptune"])
    for step, sky, which in (
        ("as both come, 2026", now, now.is_body),
        ("with UTC for UT1", its_now, now.is_body),
        ("without Moon, Uranus, Neptune", its_now, inner),
    ):
        steps.append(Step(BODY_PLACES, "arcsec, largest", step, largest_arcsec(sky, which)))
    subject, unit = "magnitudes", "mag, largest"
    off_mag = now.their_mag - now.our_mag
    stars = now.same_star
    steps.append(Step(subject, unit, "stars, as both come", float(np.abs(off_mag[stars]).max())))
    stepped = np.floor(now.our_mag[stars] / MAG_STEP + 1e-6) * MAG_STEP
    left = np.abs(now.their_mag[stars] - stepped).max()
    steps.append(Step(subject, unit, "in its catalogue's steps of 0.05", float(left)))
    moon = np.array(now.names) == "Moon"
    steps.append(Step(subject, unit, "planets", float(np.abs(off_mag[now.is_body & ~moon]).max())))
    steps.append(Step(subject, unit, "the Moon", float(np.abs(off_mag[moon]).max())))
    left_arcsec = two_digits(steps[4].size)
    bodies = two_digits(steps[7].size)
    finding = (
        f"Stellarium has stars of 2000 where hilstar has them, to {left_arcsec} arcsec by its own"
        f" UT1 and epochs, and five planets to {bodies}"
    )
    return Beside("Stellarium", version(), finding, tuple(steps))


def version() -> str:
    """The version of Debian's package."""
    told = subprocess.run(
        ["dpkg-query", "-W", "-f", "${Version}", PROGRAM],
        capture_output=True,
        text=True,
        check=True,
    )
    return told.stdout.partition("-")[0]


def seen_sky(folder: Path, utc: str) -> SeenSky:
    """Bright stars by chance, the Moon and planets, from the site on a date."""
    sky = {"epoch_utc": f"{utc}Z", "faintest_v_mag": 6.0}
    site = {"latitude_deg": LATITUDE_DEG, "longitude_deg": LONGITUDE_DEG, "height_m": HEIGHT_M}
    tables = {"sky": sky, "sky.bodies": {"planets": True, "moon": True}, "site": site}
    file = bench_file_of(folder / "site.toml", bench_text(tables))
    moving = bench_sources(file.config, file.folder).moving
    if moving is None:
        raise ValueError("a site without moving bodies")
    stars = moving.seen(moving.among(bench_stars(file.config, file.folder, moving)), 0)
    q_enu = q_icrs_to_enu(np.array([moving.utc_ns(0)]), LATITUDE_DEG, LONGITUDE_DEG)[0]
    count, bodies = len(stars), len(stars.bodies)
    enu = rotate(q_enu, replace(stars, air=None).directions(np.arange(count)))
    bright = (stars.v_mag < BRIGHT_V_MAG) & (stars.hip > 0) & (enu[:, 2] > LOWEST)
    chosen = np.random.default_rng(58).choice(np.flatnonzero(bright), STARS, replace=False)
    rows = np.concatenate([chosen, np.arange(count - bodies, count)])
    names = [*(f"HIP {hip}" for hip in stars.hip[chosen]), *stars.bodies]
    told = stellarium(folder, utc, names)
    altitude, azimuth, magnitude = np.array([told[name] for name in names]).T
    up, turn = np.radians(altitude), np.radians(azimuth)
    east, north = np.cos(up) * np.sin(turn), np.cos(up) * np.cos(turn)
    theirs = np.stack([east, north, np.sin(up)], axis=1)
    is_body = np.arange(len(names)) >= STARS
    return SeenSky(names, enu[rows], theirs, stars.v_mag[rows], magnitude, is_body, utc, q_enu)


def stellarium(folder: Path, utc: str, names: list[str]) -> dict[str, tuple[float, ...]]:
    """Geometric altitude and azimuth, degrees, and V of each object, as Stellarium tells them."""
    home = (folder / "stellarium").resolve()
    scripts, output = home / "scripts", home / "output.txt"
    scripts.mkdir(parents=True, exist_ok=True)
    output.unlink(missing_ok=True)
    text = SCRIPT.format(
        longitude=LONGITUDE_DEG,
        latitude=LATITUDE_DEG,
        height=HEIGHT_M,
        utc=utc,
        names=", ".join(f'"{name}"' for name in names),
    )
    (scripts / "beside.ssc").write_text(text)
    own = {"HOME": str(home), "LIBGL_ALWAYS_SOFTWARE": "1", "QT_QPA_PLATFORM": "xcb"}
    command = [DISPLAY, "-a", PROGRAM, "--user-dir", str(home), "--startup-script", "beside.ssc"]
    subprocess.run(
        command, env=os.environ | own, capture_output=True, timeout=ANSWERED_WITHIN_S, check=True
    )
    rows = re.findall(r"<([^|>]+)\|([-\d.e]+)\|([-\d.e]+)\|([-\d.e]+)>", output.read_text())
    return {name: (float(up), float(turn), float(mag)) for name, up, turn, mag in rows}


def rms_arcsec(sky: SeenSky, which: BoolArray) -> float:
    """The rms an axis of what lies between both."""
    apart = (sky.theirs - sky.ours)[which]
    return float(np.sqrt((apart**2).sum(axis=1).mean() / 2) * ARCSEC_PER_RAD)


def largest_arcsec(sky: SeenSky, which: BoolArray) -> float:
    """The largest distance between both."""
    return float(np.linalg.norm((sky.theirs - sky.ours)[which], axis=1).max() * ARCSEC_PER_RAD)


def as_utc(sky: SeenSky) -> SeenSky:
    """The same with hilstar's sky turned about the Earth's axis by UT1 - UTC, which Stellarium
    takes for none.
    """
    latitude = np.radians(LATITUDE_DEG)
    axis = np.array([0.0, np.cos(latitude), np.sin(latitude)])
    with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("auto_max_age", None):
        seconds = float(Time(sky.utc, scale="utc").delta_ut1_utc)
    angle = seconds * EARTH_ARCSEC_S / ARCSEC_PER_RAD
    turned = sky.ours + angle * np.cross(np.broadcast_to(axis, sky.ours.shape), sky.ours)
    return replace(sky, ours=turned)


def at_hipparcos_epoch(sky: SeenSky) -> SeenSky:
    """The same with those of hilstar's stars at their places of 1991.25 that are nearer to
    Stellarium's there.
    """
    catalog = load_catalog()
    row_of = {int(hip): row for row, hip in enumerate(catalog.hip)}
    rows = [row_of[int(name[4:])] for name in sky.names[:STARS]]
    ra, dec = np.radians(catalog.ra_deg[rows]), np.radians(catalog.dec_deg[rows])
    east = np.stack([-np.sin(ra), np.cos(ra), np.zeros_like(ra)], axis=1)
    north = np.stack([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)], axis=1)
    motion_mas = east * catalog.pm_ra_cosdec_mas_yr[rows][:, None]
    motion_mas += north * catalog.pm_dec_mas_yr[rows][:, None]
    back = motion_mas * HIPPARCOS_YEARS * 1e-3 / ARCSEC_PER_RAD
    earlier = sky.ours[:STARS] - rotate(sky.q_icrs_to_enu, back)
    apart, apart_earlier = (
        np.linalg.norm(sky.theirs[:STARS] - places, axis=1)
        for places in (sky.ours[:STARS], earlier)
    )
    ours = sky.ours.copy()
    is_earlier = apart_earlier < apart
    ours[:STARS][is_earlier] = earlier[is_earlier]
    return replace(sky, ours=ours)
