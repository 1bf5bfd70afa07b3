"""The scene a camera's own frames show, at any time between them."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dase.errors import InputError
from dase.events import Events
from dase.kernels import launch, scene_frames
from dase.kernels.pixel_stages import Frames
from dase.scenes.frame_motion import FrameMatch, match_frames
from dase.scenes.match_store import MatchStore, StoreSettings
from dase.scenes.scene import LOG_EPS, SamplingSettings, Scene


@dataclass(frozen=True)
class TrustSettings:
    """Up to which expected error the intensities between frames are trusted."""

    tolerance: float = 0.2
    """Expected error that is accepted of every pixel [log intensity]: a usual contrast threshold."""
    relative: float = 0.5
    """Expected error that is accepted as a share of what the pixel changes by between two frames: where much
    happens, an error that would be an event of its own may still be a small one."""
    moments: int = 9
    """Times between two frames, evenly from one to the other, at which a pixel must be trusted to be trusted
    throughout."""


@dataclass(frozen=True)
class MatchSettings:
    """What is kept of the matches of frames, and how they set the sampling."""

    kept: StoreSettings = field(default_factory=StoreSettings)
    """How many matches are kept."""
    speed_percentile: float = 99.8
    """Percentile of the lengths of all ways that sets how often to sample: single wild ways do not count."""


class CameraScene(Scene):
    """Linear intensity between the frames of a camera, by motion from frame to frame.

    A frame is the mean over its exposure and stands for the middle of it, where the scene equals it. In
    between, every pixel looks where its content was in the frame before and where it will be in the frame
    after (dense optical flow both ways, straight and even motion), and blends the two logarithms linearly in
    time. The scene lasts from the middle of the first exposure to the middle of the last. `doubt` says how
    far each intensity can be trusted; leave out of every comparison what `trusted` does not name.

    Args:
        frames: Any real type, shape (F, height, width), F >= 2.
        begin: Begin of each exposure [s], increasing, shape (F,), on the clock of the events.
        end: End of each exposure [s]; None for no or unknown exposure: `begin` is the time of the frame.
        gamma: Intensity is value ** gamma: 1 for a linear sensor, 2.2 for video.
        black: Value of no light; it and lower ones count as saturated.
        white: Value of intensity 1; it and higher ones count as saturated. None: the largest of the integer
            type, 1 for real numbers.
        gains: Gain and offset that undo a stretch of each frame's intensities, shape (F, 2), see
            `dase.scenes.frame_motion.estimate_stretches`.
        travel: Share of a pixel that things may move between two samples.
        shortest: Lower bound of the time between samples [s].
        longest: Upper bound of it [s].
        matching: What is kept of matches, and how they set the sampling.
        trust: Up to which expected error intensities are trusted.
        colours: Red, green and blue of the frames, of their type, shape (F, 3, height, width), for sensors
            with colour filters; the motion is that of the frames. None where there are none.
    """

    anytime = True

    def __init__(
        self,
        frames: ArrayLike,
        begin: ArrayLike,
        end: ArrayLike | None = None,
        *,
        gamma: float = 1.0,
        black: float = 0.0,
        white: float | None = None,
        gains: ArrayLike | None = None,
        travel: float = SamplingSettings.travel,
        shortest: float = SamplingSettings.shortest,
        longest: float = SamplingSettings.longest,
        matching: MatchSettings = MatchSettings(),
        trust: TrustSettings = TrustSettings(),
        colours: NDArray[Any] | None = None,
    ):
        self._raw = np.asarray(frames)
        self.begin = np.asarray(begin, np.float64)
        self.end = self.begin if end is None else np.asarray(end, np.float64)
        _check_frames_and_times(self._raw, self.begin, self.end)
        self.times = 0.5 * (self.begin + self.end)
        if not np.all(np.diff(self.times) > 0):
            raise InputError("camera: the middles of exposures must increase")
        white = full_scale(self._raw) if white is None else float(white)
        if not (np.isfinite(gamma) and gamma > 0 and np.isfinite(white) and 0 <= black < white):
            raise InputError(
                f"camera: needs gamma > 0 and 0 <= black < white, got {gamma:g}, {black:g} and {white:g}"
            )
        if not 0 < shortest <= longest or not travel > 0:
            raise InputError(
                "camera: sampling needs 0 < shortest <= longest and travel > 0, "
                f"got {shortest:g}, {longest:g} and {travel:g}"
            )
        self._gains = np.tile((1.0, 0.0), (len(self._raw), 1)) if gains is None else np.asarray(gains, float)
        if self._gains.shape != (len(self._raw), 2) or not np.all(np.isfinite(self._gains)):
            raise InputError(
                f"camera: gains must be finite, shape ({len(self._raw)}, 2), got {self._gains.shape}"
            )
        self.gamma, self.black, self.white = gamma, black, white
        self.travel, self.shortest, self.longest = travel, shortest, longest
        self.height, self.width = self._raw.shape[1:]
        self.duration = float(self.times[-1] - self.times[0])
        self.matching, self.trust = matching, trust
        self._matches = MatchStore(matching.kept)
        self._speed: dict[int, float] = {}
        self._loaded: tuple[Any, Any] = (None, None)
        self._trusted: NDArray[np.bool_] | None = None
        self._colours = colours
        if colours is not None and colours.shape != (len(self._raw), 3, *self._raw.shape[1:]):
            raise InputError(f"camera: colours must have shape (F, 3, height, width), got {colours.shape}")
        self._filter: tuple[int, float] | None = None
        """Colour and purity of what the light that is shown has passed."""

    def __len__(self) -> int:
        return len(self._raw)

    def every(self, step: int) -> CameraScene:
        """Return the scene between each `step`-th frame only."""
        return self._of_frames(slice(None, None, step))

    def within(self, first: float, last: float) -> CameraScene:
        """Return the scene between the frames about a stretch of time, from `first` to `last` [s]."""
        begin = int(np.clip(np.searchsorted(self.times, first, "right") - 1, 0, len(self) - 2))
        end = int(np.clip(np.searchsorted(self.times, last), begin + 1, len(self) - 1))
        return self._of_frames(slice(begin, end + 1))

    def _of_frames(self, kept: slice) -> CameraScene:
        return CameraScene(
            self._raw[kept], self.begin[kept], self.end[kept], gamma=self.gamma, black=self.black,
            white=self.white, gains=self._gains[kept], travel=self.travel, shortest=self.shortest,
            longest=self.longest, matching=self.matching, trust=self.trust,
            colours=None if self._colours is None else self._colours[kept],
        )  # fmt: skip

    def intensity(self, index: int) -> NDArray[np.float32]:
        """Return the linear intensity of a frame in [0, 1], shape (height, width)."""
        return self._light_of(self._raw[index], index)

    def filtered(self, purity: float) -> tuple[Scene, Scene, Scene] | None:
        """Return the scene behind a red, a green and a blue filter; see `Scene.filtered`."""
        if self._colours is None:
            return None
        red, green, blue = (copy(self) for _ in range(3))  # they share what is known of the motion
        for colour, scene in enumerate((red, green, blue)):
            scene._filter, scene._loaded = (colour, purity), (None, None)
        return red, green, blue

    def _shown(self, index: int) -> NDArray[np.float32]:
        """Return the intensity of a frame behind the filter, if there is one, shape (height, width)."""
        grey = self.intensity(index)
        if self._filter is None or self._colours is None:
            return grey
        colour, purity = self._filter
        return grey + np.float32(purity) * (self._light_of(self._colours[index, colour], index) - grey)

    def _light_of(self, raw: NDArray[Any], index: int) -> NDArray[np.float32]:
        """Return the linear intensity of values (height, width) of a frame."""
        span = np.float32(self.white - self.black)
        value = np.clip((raw.astype(np.float32) - np.float32(self.black)) / span, 0, 1)
        gain, offset = self._gains[index].astype(np.float32)
        return np.asarray(np.maximum(gain * value ** np.float32(self.gamma) + offset, 0))

    def usable(self, index: int) -> NDArray[np.bool_]:
        """Return which pixels of a frame are neither black nor white, shape (height, width)."""
        raw = self._raw[index]
        return np.asarray((raw > self.black) & (raw < self.white))

    def matched(self, interval: int) -> FrameMatch:
        """Return the motion between frame `interval` and the next."""
        found = self._matches.find(interval)
        if found is None:
            gap = self.times[interval + 1] - self.times[interval]
            exposure = (self.end - self.begin)[interval : interval + 2] / gap
            pair = interval, interval + 1
            found = match_frames(
                self.intensity(pair[0]),
                self.intensity(pair[1]),
                eps=LOG_EPS,
                exposure=(float(exposure[0]), float(exposure[1])),
                usable=(self.usable(pair[0]), self.usable(pair[1])),
            )
            self._matches.keep(interval, found)
        return found

    def sample_times(self) -> NDArray[np.float64]:
        """Return times [s] between which nothing moves by more than `travel`; those of the frames are in."""
        out = []
        for k, gap in enumerate(np.diff(self.times)):
            if k not in self._speed:
                found = self.matched(k)
                lengths = [np.linalg.norm(way, axis=-1) for way in (found.ahead, found.back)]
                self._speed[k] = float(np.percentile(np.stack(lengths), self.matching.speed_percentile))
            most, least = np.floor(gap / self.shortest + 1e-9), np.ceil(gap / self.longest - 1e-9)
            pieces = int(max(np.clip(np.ceil(self._speed[k] / self.travel), least, max(most, least)), 1))
            out.append(self.times[k] + gap * np.arange(pieces) / pieces)
        return np.append(np.concatenate(out), self.times[-1])

    def interval(self, times: ArrayLike) -> NDArray[np.int64]:
        """Return the frame before each time [s], shape (K,); the last one belongs to the last interval.

        Raises:
            InputError: A time lies outside the scene.
        """
        at = np.asarray(times, np.float64)
        if at.size and not (at.min() >= self.times[0] and at.max() <= self.times[-1]):
            raise InputError(
                f"camera: times must lie in {self.times[0]:g}..{self.times[-1]:g} s, "
                f"got {at.min():g}..{at.max():g} s"
            )
        return np.minimum(np.searchsorted(self.times, at, "right") - 1, len(self.times) - 2)

    def source(self, times: NDArray[np.float64], pixels: NDArray[np.int32], device: Any) -> tuple[str, Any]:
        """Return the intensities of these pixels, shape (K, N); see `Scene.source`."""
        source = Frames()
        matches, _, at, share = self._prepared(times, device)
        last = times == self.times[-1]  # a frame as well, as which it must come out
        at, share = np.where(last, at + 1, at).astype(np.int32), np.where(last, np.float32(0), share)
        source.values = scene_frames.render_between(matches, pixels, at, share, LOG_EPS, device)
        return "frames", source

    def frames(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.float32]:
        """Return intensities at `times` [s], shape (K, height, width)."""
        _, source = self.source(np.asarray(times, np.float64), self._all_pixels(), launch.find_device(device))
        return np.asarray(source.values.numpy().reshape(-1, self.height, self.width))

    def doubt(
        self, times: ArrayLike, *, pixels: NDArray[np.int32] | None = None, device: str = "cpu"
    ) -> NDArray[np.float32]:
        """Return the expected error of the intensity [log intensity].

        It grows with the difference between the two frames' pixels that are blended, with the gap between
        the way there and the way back, and with blur by motion during the exposures. Where a frame is
        saturated or the other frame does not show the place, it is `dase.scenes.frame_motion.HOPELESS`.

        Args:
            times: Within the scene [s], shape (K,).
            pixels: Row-major indices, shape (N,); None for all.
            device: Warp device to compute on.

        Returns:
            Shape (K, N), or (K, height, width) for all pixels.
        """
        at = np.asarray(times, np.float64)
        where = launch.find_device(device)
        matches, first, place, share = self._prepared(at, where)
        doubts = np.stack([self.matched(first + j).doubt for j in range(matches.ahead.shape[0])])
        chosen = self._all_pixels() if pixels is None else np.asarray(pixels, np.int32)
        out = scene_frames.render_doubt(matches, doubts, chosen, place, share, where)
        return out.reshape(len(at), self.height, self.width) if pixels is None else out

    def limit(
        self,
        interval: int,
        *,
        tolerance: float | None = None,
        relative: float | None = None,
        device: str = "cpu",
    ) -> NDArray[np.float32]:
        """Return the doubt accepted of each pixel between two frames [log intensity], (height, width).

        Args:
            interval: The frame before.
            tolerance: Doubt that is accepted of every pixel [log intensity]; None takes that of `trust`.
            relative: Doubt that is accepted as a share of what the pixel changes by between the frames; None
                takes that of `trust`.
            device: Warp device to compute on.
        """
        tolerance = self.trust.tolerance if tolerance is None else tolerance
        relative = self.trust.relative if relative is None else relative
        logs = np.log(self.frames(self._moments(interval), device) + np.float32(LOG_EPS))
        return np.asarray(np.maximum(np.float32(tolerance), np.float32(relative) * np.ptp(logs, axis=0)))

    def confidence(
        self, times: ArrayLike, *, tolerance: float | None = None, relative: float | None = None
    ) -> NDArray[np.float32]:
        """Return confidence, 1 without any doubt, 1/2 where it equals `limit`, (K, height, width)."""
        place = self.interval(times)
        limits = {
            int(k): self.limit(int(k), tolerance=tolerance, relative=relative) for k in np.unique(place)
        }
        share = self.doubt(times) / np.stack([limits[int(k)] for k in place])
        return np.asarray(1 / (1 + share * share))

    def trusted(
        self, *, tolerance: float | None = None, relative: float | None = None, device: str = "cpu"
    ) -> NDArray[np.bool_]:
        """Return which pixels can be trusted all the time between two frames, shape (F - 1, height, width).

        Options are those of `limit`.
        """
        out = np.empty((len(self.times) - 1, self.height, self.width), np.bool_)
        for k in range(len(out)):
            limit = self.limit(k, tolerance=tolerance, relative=relative, device=device)
            out[k] = self.doubt(self._moments(k), device=device).max(0) <= limit
        return out

    def is_trusted(self, times: NDArray[np.float64], pixels: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Return where the scene is to be trusted, as a comparison asks: never outside the scene.

        Args:
            times: Any [s], shape (K,).
            pixels: Row-major indices, shape (N,).

        Returns:
            Whether a pixel is `trusted` in the interval a time lies in, shape (K, N).
        """
        at, inside = self._within(times)
        return np.asarray(self._kept_trust()[at][:, pixels] & inside[:, None])

    def trusted_events(self, events: Events) -> Events:
        """Return the events of pixels and times at which the scene is to be trusted, see `trusts`."""
        at, inside = self._within(events.t)
        pixels = events.y.astype(np.int64) * self.width + events.x
        return events.select(self._kept_trust()[at, pixels] & inside)

    def _kept_trust(self) -> NDArray[np.bool_]:
        """Return `trusted` with pixels row by row, shape (F - 1, N)."""
        if self._trusted is None:
            self._trusted = self.trusted().reshape(len(self.times) - 1, -1)
        return self._trusted

    def _within(self, times: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the interval of each time, the nearest where it lies outside, and whether it lies inside."""
        at = np.clip(np.searchsorted(self.times, times, "right") - 1, 0, len(self.times) - 2)
        return at, (times >= self.times[0]) & (times <= self.times[-1])

    def _moments(self, interval: int) -> NDArray[np.float64]:
        """Return times from a frame to just before the next [s]."""
        begin, end = self.times[interval : interval + 2]
        moments = begin + (end - begin) * np.linspace(0, 1, self.trust.moments)
        return np.asarray(np.minimum(moments, np.nextafter(end, begin)))

    def _all_pixels(self) -> NDArray[np.int32]:
        return np.arange(self.height * self.width, dtype=np.int32)

    def _prepared(
        self, times: NDArray[np.float64], device: Any
    ) -> tuple[scene_frames.MatchedFrames, int, NDArray[np.int32], NDArray[np.float32]]:
        """Return the matches these times need, the first interval, and interval and share of each time."""
        at = self.interval(times)
        share = (times - self.times[at]) / np.diff(self.times)[at]
        first, final = int(at.min()), int(at.max())
        key = (first, final, device.alias)
        if self._loaded[0] != key:
            found = [self.matched(k) for k in range(first, final + 1)]
            frames = np.stack([self._shown(k) for k in range(first, final + 2)])
            ahead, back = (np.stack([getattr(m, name) for m in found]) for name in ("ahead", "back"))
            self._loaded = key, scene_frames.upload_matches(frames, ahead, back, LOG_EPS, device)
        return self._loaded[1], first, (at - first).astype(np.int32), share.astype(np.float32)


def full_scale(frames: NDArray[Any]) -> float:
    """Return the value of intensity 1, for frames of any shape: the largest of an integer type, else 1."""
    return float(np.iinfo(frames.dtype).max) if frames.dtype.kind in "iu" else 1.0


def _check_frames_and_times(
    frames: NDArray[Any], begin: NDArray[np.float64], end: NDArray[np.float64]
) -> None:
    if frames.ndim != 3 or len(frames) < 2 or min(frames.shape) < 1:
        raise InputError(f"camera: needs at least 2 frames of shape (F, height, width), got {frames.shape}")
    if frames.dtype.kind not in "iuf":
        raise InputError(f"camera: frames must hold real numbers, got {frames.dtype}")
    if frames.dtype.kind == "f" and not np.all(np.isfinite(frames)):
        raise InputError("camera: frames must be finite")
    for name, times in (("begin", begin), ("end", end)):
        if times.shape != (len(frames),):
            raise InputError(f"camera: {len(frames)} frames need as many times, {name} has {times.shape}")
        if not np.all(np.isfinite(times)):
            raise InputError(f"camera: {name} must be finite")
    if not np.all(end >= begin):
        raise InputError("camera: exposures must not end before they begin")
