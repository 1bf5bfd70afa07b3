"""The header of Prophesee's files: lines of `% key value`, which tell the encoding and the sensor.

    % evt 3.0                                    EVT2 (2.0), EVT2.1 (2.1) or EVT3 (3.0)
    % format EVT3;height=720;width=1280          since Metavision 4; EVT21 may add endianness=legacy
    % geometry 1280x720
    % system_ID 49                               camera, in older files the only hint at the sensor
    % end                                        since Metavision 4; older headers just stop

Source: docs.prophesee.ai, "RAW file format" and "Data encoding formats"; OpenEB (Apache-2.0).
"""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass, field

from dase.errors import InputError
from dase.io.source import Source

LONGEST = 1 << 16  # [bytes] of a header

VGA, HD = (640, 480), (1280, 720)
SYSTEMS = {
    number: size
    for size, numbers in (
        (VGA, (0x15, 0x1C, 0x17, 0x97, 0x19, 0x99, 0x1D, 0x23, 0x21, 0xA1, 0x22, 0xA2, 0x29, 0x28)),
        (HD, (0x1A, 0x1E, 0x2E, 0x1F, 0x27, 0x30, 0x32, 0x31, 0x3A, 0x42, 0x35)),
        ((320, 320), (0x3B, 0x40)),
    )
    for number in numbers
}
"""Number of a camera system to columns and rows of its sensor."""


@dataclass(frozen=True)
class Header:
    """What the header says.

    Args:
        length: Bytes until the data begin.
        keys: Last value of each key.
    """

    length: int = 0
    keys: dict[str, str] = field(default_factory=dict)

    @property
    def encoding(self) -> str | None:
        """EVT2, EVT21, EVT3 or another name; None where the header does not say."""
        name = self.keys.get("format", "").split(";")[0].strip().upper()
        old = {"2.0": "EVT2", "2.1": "EVT21", "3.0": "EVT3"}.get(self.keys.get("evt", ""))
        return {"EVT2.1": "EVT21"}.get(name, name) or old

    @property
    def options(self) -> dict[str, str]:
        """Options of the format line."""
        parts = (part.partition("=") for part in self.keys.get("format", "").split(";")[1:])
        return {name.strip(): value.strip() for name, _, value in parts}

    @property
    def size(self) -> tuple[int, int] | None:
        """Columns and rows of the sensor, or None."""
        for width, height in (
            (self.options.get("width"), self.options.get("height")),
            (self.keys.get("Width"), self.keys.get("Height")),
            tuple((self.keys.get("geometry", "") + "x").split("x")[:2]),
        ):
            if width and height and re.fullmatch("[0-9]{1,9}", width) and re.fullmatch("[0-9]{1,9}", height):
                return int(width), int(height)
        with suppress(ValueError):
            return SYSTEMS.get(int(self.keys.get("system_ID", "")))
        return None


def parse_header(head: bytes) -> Header:
    """Parse the first bytes of a file; a file without header has length 0."""
    keys: dict[str, str] = {}
    place = 0
    while head[place : place + 1] == b"%":
        end = head.find(b"\n", place)
        line = head[place + 1 : end]
        if end < 0 or not all(32 <= byte < 127 or byte in (9, 13) or byte > 160 for byte in line):
            break  # data that happen to begin with the byte of a percent sign
        place = end + 1
        key, _, value = line.decode("latin-1").strip().partition(" ")
        keys[key] = value.strip()
        if key == "end":
            break
    return Header(place, keys)


def read_header(source: Source, encoding: str | None = None) -> Header:
    """Read the header of a file; raises InputError where it does not name the encoding."""
    with source.path.open("rb") as file:
        found = parse_header(file.read(LONGEST))
    if encoding is not None and found.encoding != encoding:
        said = f"names the encoding {found.encoding}" if found.encoding else "does not name its encoding"
        raise InputError(f"its header {said}: EVT2, EVT2.1 and EVT3 are read")
    return found


def read_size(source: Source) -> tuple[int, int] | None:
    """Return columns and rows as the header tells them, or None."""
    return read_header(source).size
