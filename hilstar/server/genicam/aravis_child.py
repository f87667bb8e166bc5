"""Takes a camera's images by Aravis, for a parent (see `child_lines`): run by the system's Python,
which alone has it.

It imports nothing of hilstar, and needs Debian's gir1.2-aravis-0.8 and python3-gi.
"""

import re
import time
from pathlib import Path
from typing import Any

import gi

gi.require_version("Aravis", "0.8")
from child_lines import (  # noqa: E402
    MAX_TAKEN,
    NEVER_WHOLE,
    NOTHING_CAME,
    PATIENCE_S,
    chosen,
    main,
    refuse_format,
    refuse_padding,
)
from gi.repository import Aravis, GLib  # noqa: E402

ADDRESS = re.compile(r"\d+(?:\.\d+){3}")
BUFFERS, FILM_BUFFERS = 4, 40


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


class AravisCamera:
    """An open camera (see `child_lines.OpenCamera`)."""

    def __init__(self, name: str) -> None:
        # asked at its own address: no list is needed
        identifier = name if ADDRESS.fullmatch(name) else chosen(name, cameras())
        self.camera = Aravis.Camera.new(identifier)
        self.device = self.camera.get_device()
        # The exposure is who asks's own, and so is the light of an image.
        if self.camera.is_exposure_auto_available():
            self.camera.set_exposure_time_auto(Aravis.Auto.OFF)
        if self.camera.is_gain_auto_available():
            self.camera.set_gain_auto(Aravis.Auto.OFF)

    def adjust(self, features: dict[str, Any]) -> None:
        """Set features by their names."""
        for name, value in features.items():
            if name == "PixelFormat":
                refuse_format(value, self.camera.dup_available_pixel_formats_as_strings())
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
        stream = self._started(exposure_us, BUFFERS)
        try:
            buffer, taken = self._complete(stream, exposure_us)
        finally:
            self.camera.stop_acquisition()
        path.write_bytes(data_of(buffer))
        return {
            "format": self.camera.get_pixel_format_as_string(),
            "width": buffer.get_image_width(),
            "height": buffer.get_image_height(),
            "exposure_us": self.camera.get_exposure_time(),
            "arrived_utc_ns": buffer.get_system_timestamp(),
            "incomplete": taken - 1,
        }

    def film(
        self, exposure_us: float, path: Path, seconds: float, rows: list[int] | None
    ) -> dict[str, Any]:
        """Expose again and again for some time, and write rows of each image."""
        stream = self._started(exposure_us, FILM_BUFFERS)
        frames: list[tuple[int, int]] = []
        incomplete = 0
        size = (0, 0)
        end_s = time.monotonic() + seconds
        try:
            with path.open("wb") as output:
                while time.monotonic() < end_s:
                    buffer = stream.timeout_pop_buffer(patience_us(exposure_us))
                    if buffer is None:
                        raise LookupError(NOTHING_CAME)
                    if buffer.get_status() == Aravis.BufferStatus.SUCCESS:
                        data = data_of(buffer)
                        size = buffer.get_image_width(), buffer.get_image_height()
                        row_bytes = len(data) // size[1]
                        first, last = rows or (0, size[1])
                        output.write(data[first * row_bytes : last * row_bytes])
                        frames.append((buffer.get_timestamp(), buffer.get_system_timestamp()))
                    else:
                        incomplete += 1
                    stream.push_buffer(buffer)
        finally:
            self.camera.stop_acquisition()
        return {
            "format": self.camera.get_pixel_format_as_string(),
            "width": size[0],
            "height": size[1],
            "exposure_us": self.camera.get_exposure_time(),
            "frames": frames,
            "incomplete": incomplete,
        }

    def close(self) -> None:
        """Let it go at once."""
        if self.camera.is_gv_device():
            self.device.leave_control()

    def _started(self, exposure_us: float, buffers: int) -> Any:
        """The stream of an acquisition with an exposure."""
        self.camera.set_exposure_time(exposure_us)
        payload = self.camera.get_payload()
        stream = self.camera.create_stream(None, None)
        for _ in range(buffers):
            stream.push_buffer(Aravis.Buffer.new_allocate(payload))
        self.camera.start_acquisition()
        return stream

    def _complete(self, stream: Any, exposure_us: float) -> tuple[Any, int]:
        """The first complete buffer, and how many there were up to it."""
        triggered = self._is_triggered()
        for taken in range(1, MAX_TAKEN + 1):
            if triggered:
                self.camera.software_trigger()
            buffer = stream.timeout_pop_buffer(patience_us(exposure_us))
            if buffer is None:
                raise LookupError(NOTHING_CAME)
            if buffer.get_status() == Aravis.BufferStatus.SUCCESS:
                return buffer, taken
            stream.push_buffer(buffer)
        raise LookupError(NEVER_WHOLE)

    def _is_triggered(self) -> bool:
        try:
            mode: str = self.device.get_string_feature_value("TriggerMode")
        except GLib.Error:
            return False
        return mode == "On"


def patience_us(exposure_us: float) -> int:
    """How long an image may take."""
    return int(2 * exposure_us + PATIENCE_S * 1e6)


def data_of(buffer: Any) -> bytes:
    """The bytes of an image. Raises LookupError for lines that are padded."""
    refuse_padding(buffer.get_image_padding()[0])
    data: bytes = buffer.get_image_data()
    return data


if __name__ == "__main__":
    main(cameras, AravisCamera, (LookupError, GLib.Error))
