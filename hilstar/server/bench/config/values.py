"""The kinds of value in a bench file."""

from typing import Annotated

from msgspec import Meta

# The limits keep every product of such numbers within float64; no bench comes near them.
MIN_POSITIVE, MAX_NUMBER = 1e-6, 1e12
Positive = Annotated[float, Meta(ge=MIN_POSITIVE, le=MAX_NUMBER)]
Frequency = Annotated[float, Meta(ge=1e-6, le=1e6)]
NotNegative = Annotated[float, Meta(ge=0, le=MAX_NUMBER)]
Magnitude = Annotated[float, Meta(ge=-100, le=100)]
EpochJyear = Annotated[float, Meta(ge=1800, le=2200)]
Pixels = Annotated[int, Meta(ge=1, le=32768)]
# a GL draws sprites up to 255 px, which is 25 sigmas
SigmaPx = Annotated[float, Meta(ge=0.05, le=20)]
Size = Annotated[tuple[Pixels, Pixels], Meta(extra={"form": "[width, height]"})]
Sigma = Annotated[tuple[SigmaPx, SigmaPx], Meta(extra={"form": "[x, y]"})]
PlacePx = Annotated[float, Meta(ge=-1e6, le=1e6)]
Point = Annotated[tuple[PlacePx, PlacePx], Meta(extra={"form": "[x, y]"})]
Signed = Annotated[float, Meta(ge=-MAX_NUMBER, le=MAX_NUMBER)]
Vector = tuple[float, float, float]
IcrsVector = Annotated[Vector, Meta(extra={"form": "[x, y, z]"})]
Rotation = Annotated[tuple[float, float, float, float], Meta(extra={"form": "[w, x, y, z]"})]
