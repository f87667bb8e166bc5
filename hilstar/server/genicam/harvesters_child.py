"""Takes a camera's images by Harvesters and a vendor's GenTL producer, for a parent (see
`child_lines`).

It needs the extra hilstar[genicam], and the producer's directory in GENICAM_GENTL64_PATH.
"""

import itertools
import logging
import os
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from child_lines import (
    MAX_TAKEN,
    NEVER_WHOLE,
    NOTHING_CAME,
    PATIENCE_S,
    chosen,
    main,
    refuse_format,
    refuse_padding,
)
from genicam.genapi import GenericException as GenApiError
from genicam.gentl import GenericException as GenTLError
from harvesters.core import Harvester

EXPOSURES = ("ExposureTime", "ExposureTimeAbs")  # of SFNC, and of cameras before it
FILM_BUFFERS = 40
# How long its own look at a new buffer takes at most: a fetch that ends sooner had one.
LOOK_S = 0.05


def harvester() -> Any:
    """All producers of GENICAM_GENTL64_PATH, with their cameras. Raises LookupError for one that
    cannot be loaded.
    """
    reader = Harvester()
    folders = os.environ["GENICAM_GENTL64_PATH"].split(os.pathsep)
    producers = [sorted(Path(folder).glob("*.cti")) for folder in folders if folder]
    for producer in itertools.chain(*producers):
        try:
            reader.add_file(str(producer), check_validity=True)
        except OSError as error:
            raise LookupError(f"{producer} cannot be loaded: {error}") from error
    reader.update()
    return reader


def described(info: Any) -> dict[str, str]:
    """A camera of a producer's list."""
    facts = info.property_dict
    names = {
        "id": "id_",
        "vendor": "vendor",
        "model": "model",
        "serial": "serial_number",
        "address": "display_name",
        "protocol": "tl_type",
    }
    return {name: str(facts.get(key) or "") for name, key in names.items()}


def cameras() -> list[dict[str, str]]:
    """What the producers see, as `aravis_child` lists it; an address is the display's name."""
    reader = harvester()
    try:
        return [described(info) for info in reader.device_info_list]
    finally:
        reader.reset()


class HarvestersCamera:
    """An open camera (see `child_lines.OpenCamera`)."""

    def __init__(self, name: str) -> None:
        self.reader = harvester()
        seen = [described(info) for info in self.reader.device_info_list]
        identifier = chosen(name, seen)
        self.facts = next(facts for facts in seen if facts["id"] == identifier)
        self.acquirer = self.reader.create({"id_": identifier})
        self.features = self.acquirer.remote_device.node_map
        exposures = [key for key in EXPOSURES if hasattr(self.features, key)]
        if not exposures:
            raise LookupError("the camera has no ExposureTime")
        self.exposure = getattr(self.features, exposures[0])
        # The exposure is who asks's own, and so is the light of an image.
        for key in ("ExposureAuto", "GainAuto"):
            if hasattr(self.features, key):
                getattr(self.features, key).value = "Off"

    def adjust(self, features: dict[str, Any]) -> None:
        """Set features by their names."""
        for name, value in features.items():
            if not hasattr(self.features, name):
                raise LookupError(f"the camera has no feature {name}")
            if name == "PixelFormat":
                refuse_format(value, self.formats())
            getattr(self.features, name).value = value

    def formats(self) -> list[str]:
        """Its pixel formats."""
        return list(self.features.PixelFormat.symbolics)

    def about(self) -> dict[str, Any]:
        """What a parent is told of it."""
        return {
            "vendor": self.facts["vendor"],
            "model": self.facts["model"],
            "formats": self.formats(),
            "exposure_us": [self.exposure.min, self.exposure.max],
        }

    def take(self, exposure_us: float, path: Path) -> dict[str, Any]:
        """Expose once after now, and write the image's bytes."""
        self._start(exposure_us)
        try:
            incomplete = 0
            while (buffer := self._whole(exposure_us)) is None:
                incomplete += 1
                if incomplete == MAX_TAKEN:
                    raise LookupError(NEVER_WHOLE)
            arrived_ns = time.time_ns()
            path.write_bytes(data_of(buffer))
            size = buffer.width, buffer.height
            buffer.parent.queue_buffer(buffer)
        finally:
            self.acquirer.stop()
        return self._image_facts(size) | {
            "arrived_utc_ns": arrived_ns,
            "incomplete": incomplete,
        }

    def film(
        self, exposure_us: float, path: Path, seconds: float, rows: list[int] | None
    ) -> dict[str, Any]:
        """Expose again and again for some time, and write rows of each image."""
        frames: list[tuple[int, int]] = []
        incomplete = 0
        size = (0, 0)
        self.acquirer.num_buffers = FILM_BUFFERS
        self._start(exposure_us)
        end_s = time.monotonic() + seconds
        try:
            with path.open("wb") as output:
                while time.monotonic() < end_s:
                    buffer = self._whole(exposure_us)
                    if buffer is None:
                        incomplete += 1
                        continue
                    arrived_ns = time.time_ns()
                    data = data_of(buffer)
                    size = buffer.width, buffer.height
                    row_bytes = len(data) // size[1]
                    first, last = rows or (0, size[1])
                    output.write(data[first * row_bytes : last * row_bytes])
                    frames.append((stamp_of(buffer), arrived_ns))
                    buffer.parent.queue_buffer(buffer)
        finally:
            self.acquirer.stop()
        return self._image_facts(size) | {
            "frames": frames,
            "incomplete": incomplete,
        }

    def close(self) -> None:
        """Let it go at once."""
        self.acquirer.destroy()
        self.reader.reset()

    def _image_facts(self, size_px: tuple[int, int]) -> dict[str, Any]:
        """What a parent needs to read an image."""
        return {
            "format": self.features.PixelFormat.value,
            "width": size_px[0],
            "height": size_px[1],
            "exposure_us": self.exposure.value,
        }

    def _start(self, exposure_us: float) -> None:
        self.exposure.value = exposure_us
        self.acquirer.start()

    def _whole(self, exposure_us: float) -> Any:
        """The next buffer; None for an incomplete one, which Harvesters has given back."""
        if hasattr(self.features, "TriggerMode") and self.features.TriggerMode.value == "On":
            self.features.TriggerSoftware.execute()
        patience_s = 2e-6 * exposure_us + PATIENCE_S
        begun_s = time.monotonic()
        buffer = self.acquirer.try_fetch(timeout=patience_s, is_raw=True)
        if buffer is None and time.monotonic() - begun_s > patience_s - LOOK_S:
            raise LookupError(NOTHING_CAME)
        return buffer


def stamp_of(buffer: Any) -> int:
    """The camera's time of an image, ns; 0 where it has none."""
    try:
        return int(buffer.timestamp_ns)
    except GenTLError:
        return 0


def data_of(buffer: Any) -> bytes:
    """The bytes of an image. Raises LookupError for lines that are padded."""
    with suppress(GenTLError):  # a producer that does not know of padding
        refuse_padding(buffer.padding_x)
    return bytes(buffer.raw_buffer[: buffer.size_filled])


if __name__ == "__main__":
    logging.disable()
    main(cameras, HarvestersCamera, (LookupError, GenApiError, GenTLError))
