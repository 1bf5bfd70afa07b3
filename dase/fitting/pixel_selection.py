"""Which pixels are compared where a scene can be trusted only here and there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.events import Events
from dase.probes.stimulus import Trust, light_of
from dase.scenes.scene import Scene
from dase.scenes.video import LOG_EPS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TrustedParts:
    """Where a scene can be trusted, and how much of it that is.

    Args:
        time: Looks at which each pixel can be trusted, in the time that is fitted and in that which judges,
            shape (2, N).
        change: How far its light went in these [log intensity], shape (2, N).
        share: Part of all pixels and times that can be trusted.
        events: Part of the events of that time that lie there.
    """

    time: Array
    change: Array
    share: float
    events: float

    def sentence(self) -> str:
        """Return how much is compared."""
        return (
            "compared is only where the scene can be trusted: "
            f"{100 * self.share:.2g} % of pixels and times, with {100 * self.events:.2g} % of the events"
        )


def find_trusted_parts(
    events: Events, scene: Scene, times: Array, cut: int, trust: Trust, *, most: int = 200
) -> TrustedParts:
    """Look at all pixels now and then.

    Args:
        events: What was measured.
        scene: What the camera saw.
        times: Steps of the comparison [s], shape (T,).
        cut: The step at which the time begins that judges.
        trust: Where and when the scene is to be trusted.
        most: Times at most at which it is looked, for rendering all pixels takes long.
    """
    steps = np.unique(np.linspace(0, len(times) - 1, min(most, len(times))).astype(np.int64))
    every = np.arange(scene.width * scene.height, dtype=np.int32)
    time, change = np.zeros((2, len(every))), np.zeros((2, len(every)))
    inside = total = 0
    before: NDArray[np.float32] | None = None
    for k, step in enumerate(steps):
        at = times[step : step + 1]
        level, good = np.log(light_of(scene, at, every)[:, 0] + np.float32(LOG_EPS)), trust(at, every)[0]
        half = int(step >= cut)
        time[half] += good
        if before is not None:
            change[half] += np.where(good, np.abs(level - before), 0)
        before = level
        end = times[steps[k + 1]] if k + 1 < len(steps) else np.inf
        part = slice(*np.searchsorted(events.t, (at[0], min(end, times[-1]))))
        place = events.y[part].astype(np.int64) * events.width + events.x[part]
        inside, total = inside + int(np.count_nonzero(good[place])), total + len(place)
    return TrustedParts(time, change, float(time.mean(1).sum()) / len(steps), inside / max(total, 1))


def choose_trusted_pixels(
    looks: TrustedParts, each: int, rng: np.random.Generator, *, least: int
) -> NDArray[np.int32]:
    """Choose pixels for three parts by what the scene does where it can be trusted, never by their events.

    One in two is drawn by how long it can be trusted, the other by how far its light goes in that time, for
    in most pixels of most recordings nothing happens.

    Args:
        looks: Where it can be trusted.
        each: Pixels in each part; there are fewer where fewer can be trusted.
        rng: Random numbers.
        least: Pixels in each part without which nothing is compared.

    Returns:
        Row-major indices, shape (3 · `each`,): what is fitted, then two parts at the later time.

    Raises:
        InputError: There are next to none.
    """
    each = min(each, *(np.count_nonzero(looks.time, 1) // 3).tolist())
    if each < least:
        raise InputError(
            f"the scene can be trusted in {100 * looks.share:.2g} % of pixels and times only, "
            f"which leaves {max(each, 0)} pixels to fit and to judge; at least {least} are needed"
        )
    chosen: list[NDArray[np.int64]] = []
    free = np.ones(looks.time.shape[1])
    for half in (0, 1, 1):
        time, change = looks.time[half], looks.change[half]
        weight = free * (time / time.sum() + change / max(change.sum(), 1e-9)) * (time > 0)
        mine = rng.choice(len(free), each, replace=False, p=weight / weight.sum())
        chosen.append(rng.permutation(mine))  # those of much weight are drawn first
        free[mine] = 0
    return np.concatenate(chosen).astype(np.int32)
