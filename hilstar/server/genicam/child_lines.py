"""How a child that holds a camera and its parent talk: by lines of JSON on stdin and stdout.

    CHILD list         print the cameras, as a JSON list
    CHILD grab NAME    open a camera and print a line about it; then one for each line read:
                       {"exposure_us": ..., "file": ...} for an image, {"film": ..., "rows": ...}
                       too for many, {"set": {...}} for features

NAME is a serial number, VENDOR-MODEL, an address or the backend's own identifier; "" is the only
camera. An image's bytes go to `file`, as the camera sent them; of a film those of the wanted rows
of one image after the other. It imports nothing of hilstar: a child may run by another Python.
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

MAX_TAKEN = 8  # frames for one image: incomplete ones are taken again
# Beside the exposure. A virtual tracker's image came after 7.5 s where 30 processes shared 2 cores.
PATIENCE_S = 20.0
NOTHING_CAME = "no image came; look at the camera's link, its trigger and a firewall"
NEVER_WHOLE = (
    f"{MAX_TAKEN} images in a row came incomplete; look at the link, or a smaller packet size"
)


class OpenCamera(Protocol):
    """A camera as a child holds it. Each method raises LookupError, or the backend's own error."""

    def about(self) -> dict[str, Any]:
        """Its vendor, model, formats and shortest and longest exposure, us."""

    def adjust(self, features: dict[str, Any]) -> None:
        """Set features by their names."""

    def take(self, exposure_us: float, path: Path) -> dict[str, Any]:
        """Expose once after now, and write the image's bytes."""

    def film(
        self, exposure_us: float, path: Path, seconds: float, rows: list[int] | None
    ) -> dict[str, Any]:
        """Expose again and again for some time, and write the rows from the first to before the
        last of each image, of all by default. `frames` has each one's time by the camera and its
        arrival, ns.
        """

    def close(self) -> None:
        """Let it go at once: one that is only left is held until its heartbeat is missed."""


def chosen(name: str, seen: list[dict[str, str]]) -> str:
    """The identifier of the camera that is meant. Raises LookupError."""
    fitting = [camera["id"] for camera in seen if not name or name in names_of(camera)]
    if len(fitting) == 1:
        return fitting[0]
    if not seen:
        raise LookupError("no camera is there; write its address, such as genicam:192.168.1.10")
    listed = ", ".join(f"{camera['id']} ({camera['address']})" for camera in seen)
    raise LookupError(f"genicam:{name} fits {len(fitting)} of the cameras here: {listed}")


def names_of(camera: dict[str, str]) -> set[str]:
    """The names by which a camera is meant."""
    return {
        camera["id"],
        camera["serial"],
        camera["address"],
        f"{camera['vendor']}-{camera['model']}",
    }


def refuse_format(value: object, formats: list[str]) -> None:
    """Refuse (LookupError) a pixel format that is none of the camera's."""
    if value not in formats:
        raise LookupError(f"the camera has no PixelFormat {value}; it has {', '.join(formats)}")


def refuse_padding(pad_bytes: int) -> None:
    """Refuse (LookupError) an image whose lines are padded."""
    if pad_bytes:
        raise LookupError(
            f"each line of its image ends with {pad_bytes} bytes of padding; set another Width"
        )


def say(answer: object) -> None:
    """A line for the parent."""
    print(json.dumps(answer), flush=True)


def words_of(error: Exception) -> str:
    """What an error says."""
    return str(getattr(error, "message", "") or (error.args or [type(error).__name__])[0])


def serve(camera: OpenCamera, errors: tuple[type[Exception], ...]) -> None:
    """Say what a camera is, and do what each line asks."""
    say(camera.about())
    for line in sys.stdin:
        asked = json.loads(line)
        try:
            if "set" in asked:
                camera.adjust(asked["set"])
                say({})
            elif "film" in asked:
                path = Path(asked["file"])
                say(camera.film(asked["exposure_us"], path, asked["film"], asked["rows"]))
            else:
                say(camera.take(asked["exposure_us"], Path(asked["file"])))
        except errors as error:
            say({"error": words_of(error)})


def main(
    cameras: Callable[[], list[dict[str, str]]],
    opened: Callable[[str], OpenCamera],
    errors: tuple[type[Exception], ...],
) -> None:
    """Do what the command line asks."""
    if sys.argv[1] == "list":
        say(cameras())
        return
    try:
        camera = opened(sys.argv[2])
    except errors as error:
        say({"error": words_of(error)})
        return
    try:
        serve(camera, errors)
    except errors as error:
        say({"error": words_of(error)})
    finally:
        camera.close()
