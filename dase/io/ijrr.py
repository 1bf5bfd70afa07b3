"""Text events in a file, in a folder or in a zip, as IJRR and rpg_e2vid publish them.

    events.txt        t x y p, see `dase.io.text`
    images.txt        t filename: time of each frame [s], picture relative to the folder
    calib.txt, groundtruth.txt, imu.txt: not read

A zip holds the same, or a single text of any name. Written zips hold one text whose first line is the size of
the sensor, as rpg_e2vid wants it. Source: Mueggler et al., The event-camera dataset and simulator, 2017.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import AbstractContextManager, suppress
from pathlib import Path, PurePosixPath
from typing import IO, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.events import Events
from dase.io import arrays, frames, text
from dase.io.binary import EventWriter
from dase.io.format import LIMIT, camera_format
from dase.io.sequence import Writer, writing_file
from dase.io.source import Picture, Piece, Size, Source, refuse_bomb

EVENTS, IMAGES = "events.txt", "images.txt"
SUFFIXES = (".txt", ".csv")
PART = 1 << 16  # events turned into text at once


class _Place:
    """Where the events and the files beside them are: a folder, or a folder in a zip."""

    def __init__(self, path: Path) -> None:
        self.zip = zipfile.ZipFile(path) if path.is_file() and zipfile.is_zipfile(path) else None
        if self.zip is not None:
            name = _events_member(self.zip)
            self.folder: Path | PurePosixPath = PurePosixPath(name).parent
            self.events = PurePosixPath(name).name
        elif path.is_dir():
            self.folder, self.events = path, EVENTS
        else:
            self.folder, self.events = path.parent, path.name

    def __enter__(self) -> _Place:
        return self

    def __exit__(self, *error: object) -> None:
        if self.zip is not None:
            self.zip.close()

    def open(self, name: str) -> BinaryIO:
        """Open a file of the place; raises InputError where it leads out of it."""
        _check_name(name)
        if self.zip is None:
            return cast(BinaryIO, (Path(self.folder) / name).open("rb"))
        info = self.zip.getinfo(str(self.folder / name))
        refuse_bomb(info.compress_size, info.file_size)
        return cast(BinaryIO, self.zip.open(info))

    def has(self, name: str) -> bool:
        """Whether there is such a file; raises InputError where it leads out of the place."""
        _check_name(name)
        if self.zip is None:
            return (Path(self.folder) / name).is_file()
        return str(self.folder / name) in self.zip.NameToInfo

    def read(self, name: str, most: int) -> bytes | None:
        """Return the content of a file, None where there is no such file."""
        try:
            with self.open(name) as file:
                content = file.read(most + 1)
        except (KeyError, FileNotFoundError):
            return None
        if len(content) > most:
            raise InputError(f"{name} is larger than {most >> 20} MiB")
        return content


def _check_name(name: str) -> None:
    if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
        raise InputError(f"'{name}' leads out of the folder")


def _events_member(archive: zipfile.ZipFile) -> str:
    """Return the name of the text with the events."""
    texts = [
        name for name in archive.namelist() if name.lower().endswith(SUFFIXES) and "__MACOSX" not in name
    ]
    # by hand: an archive may have 60 000 members, and a path of each would take a second
    named = [name for name in texts if name.rpartition("/")[2] == EVENTS]
    known = (IMAGES, "calib.txt", "groundtruth.txt", "imu.txt", "readme.txt", "timestamps.txt")
    others = [name for name in texts if name.rpartition("/")[2].lower() not in known]
    found = named or others
    if len(found) != 1:
        raise InputError(f"a zip of events must hold one text of them, got {len(found)}")
    return found[0]


def read_pieces(source: Source) -> Iterator[Piece]:
    """Yield the events [s]."""
    with _Place(source.path) as place:
        yield from text.decode_text(lambda: place.open(place.events), source)


def read_size(source: Source) -> Size | None:
    """Return the size that the text or the first frame tells, or None."""
    with _Place(source.path) as place:
        with place.open(place.events) as file:
            known = text.Layout(file.read(text.LIMITS.head)).size
        if known is None and (listed := _listed_frames(place)):
            first = place.read(listed[0][1], LIMIT)
            if first is not None:
                height, width = frames.decode_grey(first, listed[0][1]).shape
                return width, height
        return known


def _listed_frames(place: _Place) -> list[tuple[float, str]]:
    """Return time [s] and name of the frames beside events.txt."""
    content = place.read(IMAGES, most=1 << 26) if place.events == EVENTS else None
    out = []
    for number, line in enumerate((content or b"").decode("latin-1").splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            out.append((float(words[0]), words[1]))
        except (ValueError, IndexError):
            raise InputError(f"{IMAGES}: line {number} is not 't filename'") from None
    return out


def read_pictures(source: Source) -> Iterator[Picture]:
    """Yield the frames that images.txt lists [s]; none where one of them is missing."""
    with _Place(source.path) as place:
        listed = _listed_frames(place)
        times = np.array([time for time, _ in listed])
        if not np.all(np.isfinite(times)) or np.any(np.diff(times) < 0):
            raise InputError(f"{IMAGES}: times of frames must be finite and must not go back")
        missing = next((name for _, name in listed if not place.has(name)), None)
        if missing is not None:
            sentence = f"{IMAGES} lists '{missing}', which is missing: frames left out"
            return source.note(sentence, "refused", "frames", len(listed))
        for time, name in listed:
            yield Picture(frames.decode_grey(place.read(name, LIMIT) or b"", name), time)


def matches_text(path: Path, head: bytes) -> bool:
    """Whether a file or folder holds events as text."""
    if path.is_dir():
        return (path / EVENTS).is_file()
    return text.matches_head(head)


def matches_zip(path: Path, head: bytes) -> bool:
    """Whether a zip holds a text."""
    if not head.startswith(arrays.ZIP):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except Exception:  # damaged: left to the reader that is tried at last
        return False
    return any(name.lower().endswith(SUFFIXES) for name in names) and not any(
        n.endswith(".npy") for n in names
    )


class _Writer(EventWriter):
    name = "text"

    def _header(self, width: int, height: int) -> bytes:
        return f"# {width} {height} columns and rows; t [s], x, y, p (1 = ON)\n".encode()

    def _microseconds(self, t: NDArray[np.float64]) -> NDArray[np.int64]:
        return np.empty(0, np.int64)  # a text keeps all digits

    def _encoded(self, part: Events, t_us: NDArray[np.int64]) -> bytes:
        slices = (slice(i, i + PART) for i in range(0, len(part), PART))
        return b"".join(text.encode_events(part.t[k], part.x[k], part.y[k], part.p[k]) for k in slices)


class _ZipWriter(_Writer):
    """Writes the text into a zip; the same content gives the same bytes."""

    name = "zip of text"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._zip = zipfile.ZipFile(self._file, "w", zipfile.ZIP_DEFLATED, compresslevel=1)
        info = zipfile.ZipInfo("events.txt")  # dated 1980, always
        info.compress_type = zipfile.ZIP_DEFLATED
        self._outer = self._file
        self._member: IO[bytes] = self._zip.open(info, "w", force_zip64=True)
        self._file = cast(BinaryIO, self._member)

    def _header(self, width: int, height: int) -> bytes:
        return f"{width} {height}\n".encode()

    def finish(self) -> None:
        """Write the header if no event came, and close."""
        super().finish()
        self._zip.close()
        self._outer.close()

    def abandon(self) -> None:
        """Close the files."""
        for part in (self._member, self._zip, self._outer):
            with suppress(Exception):
                part.close()


def create_text(path: Path) -> AbstractContextManager[Writer]:
    """Open a text for writing; it appears under its name when the block ends well."""
    return writing_file(path, _Writer)


def create_zip(path: Path) -> AbstractContextManager[Writer]:
    """Open a zip of a text for writing; it appears under its name when the block ends well."""
    return writing_file(path, _ZipWriter)


TEXT = camera_format(
    name="text",
    suffixes=SUFFIXES,
    create=create_text,
    matches=matches_text,
    pieces=read_pieces,
    size=read_size,
    pictures=read_pictures,
    ticks=1.0,
    asks=frozenset({"columns"}),
)
ZIPPED = camera_format(
    name="zip of text",
    suffixes=(".zip",),
    create=create_zip,
    matches=matches_zip,
    pieces=read_pieces,
    size=read_size,
    pictures=read_pictures,
    ticks=1.0,
    asks=frozenset({"columns"}),
)
