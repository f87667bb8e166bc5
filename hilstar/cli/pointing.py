"""Where the command line points: `--radec`, `--star` or `--quaternion`."""

from typing import TYPE_CHECKING

from hilstar.basics.errors import InputError, shortened
from hilstar.cli.completion import offered, stars
from hilstar.cli.declare import option, struct
from hilstar.cli.options import parse_numbers

if TYPE_CHECKING:
    from hilstar.basics.arrays import FloatArray

RADEC_FORM = "RA,DEC,ROLL in degrees, such as 84.057,-1.2,0, or sexagesimal: 5h36m14s,-1d12m,0"
USUAL_EPOCH_JYEAR = 2026.0  # that of a bench file which states none


@struct
class PlaceOptions:
    """A boresight and a roll, by a place or a star."""

    radec: str | None = option(
        "RA,DEC,ROLL",
        "Boresight and roll, ICRS: degrees, or sexagesimal (5h36m14s,-1d12m,0).",
    )
    star: str | None = option(
        "NAME|HIP[,ROLL]",
        "Boresight at a star: its name (Vega, alpha Lyr) or Hipparcos number; roll 0 if none.",
        autocompletion=offered(stars),
    )


@struct
class PointingOptions(PlaceOptions):
    """An attitude, by a place, a star or a quaternion."""

    quaternion: str | None = option("W,X,Y,Z", "q_icrs_to_cam, scalar first.")

    @property
    def given(self) -> list[str]:
        """The attitudes that the command line states, as texts; `attitude_of` refuses more than
        one.
        """
        texts = (self.radec, self.star, self.quaternion)
        return [text for text in texts if text is not None]


def attitude_of(
    command: str, pointing: PointingOptions, epoch_jyear: float = USUAL_EPOCH_JYEAR
) -> "FloatArray":
    """The one attitude that the command line gives, q_icrs_to_cam (4,). Raises InputError."""
    from hilstar.basics.rotation import from_radec_roll_deg
    from hilstar.server.bench.frame import checked_quaternion

    if len(pointing.given) != 1:
        raise InputError(
            f"{command}: give the attitude with one of --radec RA,DEC,ROLL, --star NAME and"
            " --quaternion W,X,Y,Z"
        )
    place = place_of(command, pointing, epoch_jyear)
    if place is not None:
        return from_radec_roll_deg(*place)
    return checked_quaternion(parse_numbers(pointing.given[0], 4, "--quaternion", "W,X,Y,Z"))


def optional_attitude(
    command: str, pointing: PointingOptions, epoch_jyear: float = USUAL_EPOCH_JYEAR
) -> "FloatArray | None":
    """The same, and None where the command line gives none. Raises InputError."""
    if not pointing.given:
        return None
    return attitude_of(command, pointing, epoch_jyear)


def place_of(
    command: str, pointing: PlaceOptions, epoch_jyear: float = USUAL_EPOCH_JYEAR
) -> tuple[float, float, float] | None:
    """Right ascension, declination and roll, degrees, by --radec or --star; None without either.
    Raises InputError.
    """
    if pointing.radec is not None and pointing.star is not None:
        raise InputError(f"{command}: --radec and --star both say where; leave one out")
    if pointing.radec is not None:
        return parse_radec(pointing.radec)
    if pointing.star is not None:
        return parse_star(pointing.star, epoch_jyear)
    return None


def parse_radec(text: str) -> tuple[float, float, float]:
    """Right ascension, declination and roll in degrees. Raises InputError."""
    parts = [part.strip() for part in text.split(",")]
    if len(parts) == 1 and (meant := _star_named(text)):
        raise InputError(f"--radec {shortened(text)}: is a star; write --star {meant}")
    if len(parts) == 3 and not all(map(_is_number, parts[:2])):
        # declinations are not in hours: the two are swapped
        if "h" in parts[1]:
            raise InputError(f"--radec {shortened(text)}: write {RADEC_FORM}")
        # without a unit, a right ascension of several parts is hours
        ra_deg = _sexagesimal_deg(parts[0], "hourangle", text)
        dec_deg = _sexagesimal_deg(parts[1], "deg", text)
        text_deg = f"{ra_deg!r},{dec_deg!r},{parts[2]}"
    else:
        text_deg = text
    try:
        ra_deg, dec_deg, roll_deg = parse_numbers(text_deg, 3, "--radec", RADEC_FORM)
    except InputError as error:
        if text_deg is text:
            raise
        raise InputError(f"--radec {shortened(text)}: write {RADEC_FORM}") from error
    if not -90 <= dec_deg <= 90:
        raise InputError(f"--radec {text}: write a declination from -90 to 90")
    return ra_deg, dec_deg, roll_deg


def parse_star(text: str, epoch_jyear: float) -> tuple[float, float, float]:
    """Right ascension, declination and roll in degrees of "Vega" or "Vega,30". Raises
    InputError.
    """
    from hilstar.sky import named_stars

    name, comma, roll_text = text.partition(",")
    if comma and not _is_number(roll_text):
        raise InputError(f"--star {shortened(text)}: write NAME,ROLL in degrees, such as Vega,30")
    roll_deg = parse_numbers(roll_text, 1, "--star", "ROLL")[0] if comma else 0.0
    try:
        return *named_stars.star_place_deg(name, epoch_jyear), roll_deg
    except InputError as error:
        raise InputError(f"--star {error}") from error


def _star_named(text: str) -> str:
    """A star's name as an option's value; "" for what is no name."""
    from hilstar.sky.named_stars import hip_named

    if hip_named(text) is None:
        return ""
    return f"'{text}'" if " " in text else text


def _is_number(text: str) -> bool:
    """Whether an angle is a number of degrees."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _sexagesimal_deg(text: str, unit: str, whole: str) -> float:
    """An angle in degrees: a number of degrees, or "5h36m14s", "5:36:14", "-1d12m" by `unit`."""
    if _is_number(text):
        return float(text)
    import warnings

    from astropy.coordinates import Angle  # 0.3 s, which degrees do not need

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # 60 minutes, or seconds, are a slip
            return float(Angle(text, unit=unit).deg)
    except (ValueError, TypeError, Warning) as error:
        raise InputError(f"--radec {shortened(whole)}: write {RADEC_FORM}") from error
