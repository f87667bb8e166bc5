"""Takes a camera's images by Aravis, for a parent: run by the system's Python, which alone has it.

    aravis_child.py list         print the cameras, as a JSON list
    aravis_child.py grab NAME    open a camera and print a line of JSON about it; then one for each
                                 line read: {"exposure_us": ..., "file": ...} for
                                 an image, {"set": {...}} for features

NAME is a serial number, VENDOR-MODEL, an address or Aravis's own identifier; "" is the only camera.
An image's bytes go to `file`, as the camera sent them. It imports nothing of hilstar, and needs
Debian's gir1.2-aravis-0.8 and python3-gi.
"""

import json
import re
import sys
from pathlib import Path
from typing import Any

import gi

gi.require_version("Aravis", "0.8")
from gi.repository import Aravis, GLib  # noqa: E402

ADDRESS = re.compile(r"\d+(?:\.\d+){3}")
BUFFERS = 4
MAX_TAKEN = 8  # frames for one image: incomplete ones are taken again
PATIENCE_US = 5_000_000  # beside the exposure


def cameras() -> list[dict[str, str]]:
    """What Aravis sees: identifier, vendor, model, serial number, address and protocol of each."""
    Aravis.update_device_list()
    return [
        {
            "id": Aravis.get_device_id(k),
            "vendor": Aravis.get_device_vendor(k),
            "model": Aravis.get_device_model(k),
            "serial": Aravis.get_device_serial_nbr(k),
            "address": Aravis.get_device_address(k),
            "protocol": Aravis.get_device_protocol(k),
        }
        for k in range(Aravis.get_n_devices())
    ]


def names_of(camera: dict[str, str]) -> set[str]:
    """The names by which a camera is meant."""
    return {
        camera["id"],
        camera["serial"],
        camera["address"],
        f"{camera['vendor']}-{camera['model']}",
    }


def chosen(name: str) -> str:
    """The identifier to open. Raises LookupError."""
    if ADDRESS.fullmatch(name):
        return name  # asked at its own address: no list is needed
    seen = cameras()
    fitting = [camera["id"] for camera in seen if not name or name in names_of(camera)]
    if len(fitting) == 1:
        return fitting[0]
    listed = ", ".join(f"{camera['id']} ({camera['address']})" for camera in seen) or "none"
    if not seen:
        raise LookupError("no camera is there; write its address, such as genicam:192.168.1.10")
    raise LookupError(f"genicam:{name} fits {len(fitting)} of the cameras here: {listed}")


class Camera:
    """An open camera."""

    def __init__(self, identifier: str) -> None:
        self.camera = Aravis.Camera.new(identifier)
        self.device = self.camera.get_device()
        # The exposure is who asks's own, and so is the light of an image.
        if self.camera.is_exposure_auto_available():
            self.camera.set_exposure_time_auto(Aravis.Auto.OFF)
        if self.camera.is_gain_auto_available():
            self.camera.set_gain_auto(Aravis.Auto.OFF)

    def adjust(self, features: dict[str, Any]) -> None:
        """Set features by their names, the pixel format first."""
        for name, value in features.items():
            if name == "PixelFormat":
                formats = self.camera.dup_available_pixel_formats_as_strings()
                if value not in formats:
                    raise LookupError(
                        f"the camera has no PixelFormat {value}; it has {', '.join(formats)}"
                    )
            if isinstance(value, bool):
                self.device.set_boolean_feature_value(name, value)
            elif isinstance(value, int):
                self.device.set_integer_feature_value(name, value)
            elif isinstance(value, float):
                self.device.set_float_feature_value(name, value)
            else:
                self.device.set_string_feature_value(name, value)

    def about(self) -> dict[str, Any]:
        """What a parent is told of it."""
        low_us, high_us = self.camera.get_exposure_time_bounds()
        return {
            "vendor": self.camera.get_vendor_name(),
            "model": self.camera.get_model_name(),
            "formats": self.camera.dup_available_pixel_formats_as_strings(),
            "exposure_us": [low_us, high_us],
        }

    def take(self, exposure_us: float, path: Path) -> dict[str, Any]:
        """Expose once after now, and write the image's bytes."""
        self.camera.set_exposure_time(exposure_us)
        payload = self.camera.get_payload()
        stream = self.camera.create_stream(None, None)
        for _ in range(BUFFERS):
            stream.push_buffer(Aravis.Buffer.new_allocate(payload))
        self.camera.start_acquisition()
        try:
            buffer, taken = self._complete(stream, exposure_us)
        finally:
            self.camera.stop_acquisition()
        pad_bytes, _ = buffer.get_image_padding()
        if pad_bytes:
            raise LookupError(
                f"each line of its image ends with {pad_bytes} bytes of padding; set another Width"
            )
        path.write_bytes(buffer.get_image_data())
        return {
            "format": self.camera.get_pixel_format_as_string(),
            "width": buffer.get_image_width(),
            "height": buffer.get_image_height(),
            "exposure_us": self.camera.get_exposure_time(),
            "arrived_utc_ns": buffer.get_system_timestamp(),
            "incomplete": taken - 1,
        }

    def _complete(self, stream: Any, exposure_us: float) -> tuple[Any, int]:
        """The first complete buffer, and how many there were up to it."""
        triggered = self._is_triggered()
        for taken in range(1, MAX_TAKEN + 1):
            if triggered:
                self.camera.software_trigger()
            buffer = stream.timeout_pop_buffer(int(2 * exposure_us) + PATIENCE_US)
            if buffer is None:
                raise LookupError(
                    "no image came; look at the camera's link, its trigger and a firewall"
                )
            if buffer.get_status() == Aravis.BufferStatus.SUCCESS:
                return buffer, taken
            stream.push_buffer(buffer)
        raise LookupError(
            f"{MAX_TAKEN} images in a row came incomplete; look at the link, or a smaller packet"
            " size"
        )

    def _is_triggered(self) -> bool:
        try:
            mode: str = self.device.get_string_feature_value("TriggerMode")
        except GLib.Error:
            return False
        return mode == "On"


def serve(name: str) -> None:
    """Open a camera, say what it is, and do what each line asks."""
    camera = Camera(chosen(name))
    say(camera.about())
    for line in sys.stdin:
        asked = json.loads(line)
        try:
            if "set" in asked:
                camera.adjust(asked["set"])
                say({})
            else:
                say(camera.take(asked["exposure_us"], Path(asked["file"])))
        except (LookupError, GLib.Error) as error:
            say({"error": words_of(error)})


def words_of(error: Exception) -> str:
    """What an error says."""
    return str(getattr(error, "message", "") or error.args[0])


def say(answer: object) -> None:
    """A line for the parent."""
    print(json.dumps(answer), flush=True)


def main() -> None:
    """Do what the command line asks."""
    if sys.argv[1] == "list":
        say(cameras())
        return
    try:
        serve(sys.argv[2])
    except (LookupError, GLib.Error) as error:
        say({"error": words_of(error)})


if __name__ == "__main__":
    main()
