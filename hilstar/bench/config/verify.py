"""[verify]."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from hilstar.bench.config.values import NotNegative, Positive, Rotation
from hilstar.toml_tables import Table

AS_ASSUMED = {"default": "as the bench assumes"}


class Verify(Table, frozen=True):
    """The digital twin: what `hilstar verify` takes as true where the bench assumes otherwise, and the limits within which
    the bench passes.

    The bench draws random attitudes as it believes itself to be; the monitor as it truly is turns the codes into light, and
    the tracker measures each star without noise. `flux_error_mag` and `centroid_error_px` compare that with the same
    measurement of the tracker's image of the linear image, so that the errors of the estimator itself (`estimator_floor`,
    against the catalogue) are not charged to the display.

    A star is **lost** when nothing is found within 3 px of its true place. Counted, but not part of the errors: `blended`
    (others put more than 2 % of its light into its window), `clipped`, `not_shown` (too faint for the monitor), `at_edge` (of
    the detector or the monitor). Stars that the tracker cannot part, within 1.5 sigmas of what it sees of a star, are measured
    as one of the sum at the centre of their light; `summed` counts those added to a brighter one. `codes_alone` is what the
    codes would cost were everything else as assumed; `noisy` is the same with all of `[tracker.detector]`. `scale_error`,
    `rotation_arcsec`, `offset_px`, `tilt_deg`, `k1` and `distortion_px` (by the lens, the largest in the field) are those of
    the smallest model that explains the centroids, true minus assumed; what it does not need is 0. `reasons` names what failed
    and its likely cause.

    `-o DIR` writes `errors.png`, `field.png` and `stars.csv` (a row per star, with `nan` for the errors of a lost one). The
    exit code is 0 whatever the verdict; with `--strict` it is 1 when the bench does not pass.
    """

    true_calibration: Annotated[
        str | None,
        Meta(description="The monitor's true light: a built-in name or a calibration file.", extra=AS_ASSUMED),
    ] = None
    true_flux_at_white_e_per_s: Annotated[Positive | None, Meta(description="The true full scale.", extra=AS_ASSUMED)] = None
    true_focal_length_mm: Annotated[
        Positive | None, Meta(description="The collimator's true focal length.", extra=AS_ASSUMED)
    ] = None
    true_pixel_pitch_um: Annotated[Positive | None, Meta(description="The monitor's true pixel pitch.", extra=AS_ASSUMED)] = (
        None
    )
    true_q_cam_to_mon: Annotated[Rotation | None, Meta(description="The true misalignment.", extra=AS_ASSUMED)] = None
    true_geometry: Annotated[
        str | None,
        Meta(
            description="The true lens and the true alignment: a file as `hilstar calibrate geometric` writes it. Not beside "
            "`true_focal_length_mm`, `true_pixel_pitch_um` or `true_q_cam_to_mon`, which are of an ideal lens.",
            extra=AS_ASSUMED,
        ),
    ] = None
    true_mirror: Annotated[
        Literal["none", "x", "y", "swap"],
        Meta(
            description='What the screen truly does: `"none"`, reverses columns (`"x"`), reverses rows (`"y"`), or swaps its '
            'axes (`"swap"`).'
        ),
    ] = "none"
    centroider: Annotated[
        Literal["window", "wide", "moment", "fit", "box3", "box5"] | None,
        Meta(
            description='What the tracker finds its stars by: `"window"`, a Gaussian that follows the star and is as wide; '
            '`"wide"`, one half as wide again; `"moment"`, the plain first moment; `"fit"`, the least squares of a PSF; '
            '`"box3"` or `"box5"`, the centre of mass of so many pixels a side. '
            '`quantisation = "auto"` judges codes by it, too.',
            extra={"default": '`"window"`; to judge codes, all of them'},
        ),
    ] = None
    flux_mag: Annotated[
        Positive,
        Meta(
            description="Limit for the flux error of 95 % of stars, with their common zero point taken out; also the limit of "
            "that zero point."
        ),
    ] = 0.05
    centroid_px: Annotated[Positive, Meta(description="Limit for the centroid error of 95 % of stars, in tracker pixels.")] = (
        0.1
    )
    lost_share: Annotated[
        NotNegative,
        Meta(description="Limit for the share of lost stars among those that stand alone, are shown, and are not clipped."),
    ] = 0.02
    black_e_per_s_px: Annotated[
        NotNegative | None,
        Meta(
            description="Limit for the screen's black level in a tracker pixel, seen minus assumed.",
            extra={"default": "a tenth of the faintest star's light over its disc (4 pi sigma^2)"},
        ),
    ] = None
