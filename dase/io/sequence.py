"""Sequence, what one simulation produces, and what every file format needs to write and read one."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.events import Events
from dase.files.atomic_file import replacing as replacing

Grey = np.uint8 | np.uint16
GREYS = (np.uint8, np.uint16)
"""Types of grey images; white is their largest number."""


@dataclass(frozen=True, repr=False)
class Sequence:
    """Events of one sensor and what is known beside them.

    Args:
        events: The events; their width and height are those of all maps below.
        frames: Grey images, uint8 or uint16, shape (F, H, W).
        frame_times: Middle of each frame's exposure [s], float64, shape (F,). None where it is unknown.
        flow: Optical flow [px/s], x then y, float32, shape (F, 2, H, W); without frames any number of maps.
        thresholds: Contrast thresholds used, OFF then ON [log intensity], float32, shape (2, H, W).
        configuration: TOML text of everything that made the sequence.
        frame_exposure: Exposure durations [s], float64, shape (F,). None for ideal frames.

    Raises:
        InputError: A shape disagrees with the sensor or with the number of frames.
    """

    events: Events
    frames: NDArray[Grey] | None = None
    frame_times: NDArray[np.float64] | None = None
    flow: NDArray[np.float32] | None = None
    thresholds: NDArray[np.float32] | None = None
    configuration: str | None = None
    frame_exposure: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        size = (self.events.height, self.events.width)
        count = None if self.frames is None else len(self.frames)
        maps = {"frames": (count,), "flow": (count, 2), "thresholds": (2,)}
        for name, leading in maps.items():
            _check_shape(name, getattr(self, name), (*leading, *size))
        for name in ("frame_times", "frame_exposure"):
            _check_shape(name, getattr(self, name), (count,))

    def __repr__(self) -> str:
        names = ("frames", "frame_times", "flow", "thresholds", "frame_exposure")
        arrays = [(name, getattr(self, name)) for name in names]
        there = [f"  {name} {array.shape} {array.dtype}" for name, array in arrays if array is not None]
        return "\n".join(["Sequence", f"  {self.events}", *there])

    @property
    def span(self) -> tuple[float, float]:
        """First and last time of an event or frame [s]; (0, 0) where there is neither."""
        known = [self.events.t] + ([] if self.frame_times is None else [self.frame_times])
        times = [time for part in known if len(part) for time in (float(part[0]), float(part[-1]))]
        return (min(times), max(times)) if times else (0.0, 0.0)


def _check_shape(name: str, array: NDArray[Any] | None, want: tuple[int | None, ...]) -> None:
    if array is None:
        return
    shape = array.shape
    if len(shape) != len(want) or any(b is not None and a != b for a, b in zip(shape, want, strict=True)):
        wanted = ", ".join("any" if n is None else str(n) for n in want)
        raise InputError(f"sequence: {name} must have shape ({wanted}), got {shape}")


class Writer(ABC):
    """Takes a sequence piece by piece; a format stores the pieces.

    The first piece with a size sets the sensor's. Events and frames may come in any mixture, each in order
    of time.
    """

    def __init__(self) -> None:
        self.size: tuple[int, int] | None = None  # height, width
        self._last_event = -math.inf
        self._last_frame = -math.inf
        self._with_flow: bool | None = None
        self._with_labels: bool | None = None
        self._frames = 0
        self._grey: np.dtype[Any] | None = None
        self._once: set[str] = set()

    def events(self, part: Events) -> None:
        """Append events.

        Args:
            part: Events that follow those written before; may be empty, which still tells the size.

        Raises:
            InputError: They go back in time, lie outside the sensor, have labels where others have none, or
                the sensor's size changed.
        """
        self._same_size((part.height, part.width), "events")
        if len(part) or part.label is not None:
            if self._with_labels not in (None, part.label is not None):
                raise InputError("events: labels must come with all events or with none")
            self._with_labels = part.label is not None
        if not len(part):
            return
        begin, end = float(part.t[0]), float(part.t[-1])
        if not (math.isfinite(begin) and math.isfinite(end) and bool(np.all(part.t[1:] >= part.t[:-1]))):
            raise InputError("events: times must be finite and sorted")
        if begin < self._last_event:
            raise InputError(f"events: a part begins at {begin:g} s, before {self._last_event:g} s")
        if int(part.x.max()) >= part.width or int(part.y.max()) >= part.height:
            raise InputError(f"events: coordinates must lie inside the {part.width}x{part.height} sensor")
        self._last_event = end
        self._put_events(part)

    def frame(
        self,
        time: float,
        grey: NDArray[Grey],
        flow: NDArray[np.float32] | None = None,
        *,
        exposure: float = 0.0,
    ) -> None:
        """Append a frame.

        Args:
            time: Middle of the exposure [s], not before the frame before.
            grey: Image, uint8 or uint16 like the first, shape (H, W).
            flow: Optical flow at `time` [px/s], x then y, shape (2, H, W): for all frames or for none.
            exposure: Duration of the exposure [s].

        Raises:
            InputError: A time, shape or type is wrong.
        """
        wanted = GREYS if self._grey is None else (self._grey,)
        if grey.dtype not in wanted or grey.ndim != 2:
            names = " or ".join(np.dtype(kind).name for kind in wanted)
            raise InputError(
                f"frame: must be {names} of shape (H, W), got {grey.dtype} of shape {grey.shape}"
            )
        self._same_size(grey.shape, "frame")
        if not (math.isfinite(time) and time >= self._last_frame):
            raise InputError(f"frame: time must not be before {self._last_frame:g} s, got {time:g} s")
        if not 0.0 <= exposure < math.inf:
            raise InputError(f"frame: exposure must be >= 0 s, got {exposure:g} s")
        if flow is not None:
            _check_shape("flow", flow, (2, *grey.shape))
        if self._with_flow not in (None, flow is not None):
            raise InputError("frame: flow must come with all frames or with none")
        self._with_flow = flow is not None
        self._last_frame = time
        self._grey = grey.dtype
        self._put_frame(self._frames, time, grey, flow, exposure)
        self._frames += 1

    def thresholds(self, values: NDArray[np.float32]) -> None:
        """Store the thresholds used, OFF then ON [log intensity], shape (2, H, W); at most once."""
        self._only_once("thresholds")
        if values.ndim != 3 or len(values) != 2:
            raise InputError(f"thresholds: must have shape (2, H, W), got {values.shape}")
        self._same_size(values.shape[1:], "thresholds")
        self._put_thresholds(values.astype(np.float32))

    def configuration(self, text: str) -> None:
        """Store the TOML text of everything that made the sequence; at most once."""
        self._only_once("configuration")
        self._put_configuration(text)

    def _same_size(self, size: tuple[int, ...], what: str) -> None:
        if self.size is None:
            self.size = (size[0], size[1])
        if self.size != size:
            want, got = self.size, size
            raise InputError(f"{what}: the sensor is {want[1]}x{want[0]}, got {got[1]}x{got[0]}")

    def _only_once(self, what: str) -> None:
        if what in self._once:
            raise InputError(f"{what}: already written to this file")
        self._once.add(what)

    @abstractmethod
    def finish(self) -> None:
        """Write what is left and close; raises InputError if no piece told the sensor's size."""

    @abstractmethod
    def abandon(self) -> None:
        """Close without caring for the content; never raises."""

    @abstractmethod
    def _put_events(self, part: Events) -> None: ...

    @abstractmethod
    def _put_frame(
        self,
        index: int,
        time: float,
        grey: NDArray[Grey],
        flow: NDArray[np.float32] | None,
        exposure: float,
    ) -> None: ...

    @abstractmethod
    def _put_thresholds(self, values: NDArray[np.float32]) -> None: ...

    @abstractmethod
    def _put_configuration(self, text: str) -> None: ...


@contextmanager
def writing_file(path: Path, make: Callable[[Path], Writer]) -> Iterator[Writer]:
    """Yield the writer that `make` opens on a temporary name; see `replacing`."""
    with replacing(path) as temporary:
        writer = make(temporary)
        try:
            yield writer
            if writer.size is None:
                raise InputError(f"{path}: nothing was written, not even the size of the sensor")
            writer.finish()
        except BaseException:
            writer.abandon()
            raise


@contextmanager
def reading_file(path: Path, kind: str) -> Iterator[None]:
    """Turn whatever a damaged file makes its library raise into one sentence that names the file."""
    try:
        yield
    except InputError as error:
        if str(error).startswith(f"{path}: "):
            raise  # from a reader within a reader
        raise type(error)(f"{path}: {_one_line(error)}") from error
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except Exception as error:  # h5py, zipfile, zlib and numpy have no common error for damaged files
        why = _one_line(error) or type(error).__name__
        raise InputError(f"{path}: cannot be read as {kind}, damaged or cut short ({why})") from error


def _one_line(error: Exception) -> str:
    """Return what an error says in one line; names out of a damaged file may hold anything."""
    return "".join(c if c.isprintable() else "?" for c in " ".join(str(error).split()))


def checked_coordinates(values: NDArray[Any], name: str) -> NDArray[np.uint16]:
    """Return pixel coordinates, shape (N,), as uint16; raises InputError where they do not fit.

    Real numbers are taken where they are whole ones: a fraction is never cut.
    """
    if values.dtype.kind == "f":
        wrong = np.flatnonzero(~(values == np.floor(values)) | ~np.isfinite(values))
        if len(wrong):
            raise InputError(f"{name} must be whole numbers, got {values[wrong[0]]:g}")
    elif values.dtype.kind not in "iu":
        raise InputError(f"{name} must be integers, got {values.dtype}")
    if values.size and (int(values.min()) < 0 or int(values.max()) > 65535):
        raise InputError(f"{name} must lie in 0..65535, got {values.min()}..{values.max()}")
    return values.astype(np.uint16, copy=False)
