"""The pixels of a sensor that are not looked at: what they send over the bus that all pixels share."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dase.effects.stream import Others, StreamEffect
from dase.events import Events
from dase.probes.random_streams import Draw
from dase.probes.stimulus import Stimulus
from dase.scenes.scene import Scene
from dase.simulation.sensor import Sensor
from dase.simulation.sensor_run import SensorRun


@dataclass(frozen=True, eq=False)
class WholeSensor:
    """A scene as all pixels see it.

    Args:
        scene: What they see.
        times: Points of the grid of time [s], shape (T,).
        seed: Of the random numbers, and of which pixels stand for all.
        device: Where kernels run.
        most_samples: Pixels times points of time that are simulated: of a larger sensor or a longer time,
            some pixels stand for all.
        most_events: Events that all of them send: of a model that sends more, some stand for all, too.
        counted: Events of the pixels that are looked at which tell how many those send: they are simulated
            again, at most `repeats` times, until there are as many.
        repeats: See `counted`.
        kept: Present models whose load is kept.
    """

    scene: Scene
    times: NDArray[np.float64]
    seed: int
    device: str
    most_samples: float = 2.5e7
    most_events: float = 6e6
    counted: float = 2e4
    repeats: int = 8
    kept: int = 3
    _loads: list[BusLoad] = field(default_factory=list, repr=False)

    def load(self, sensor: Sensor, stimulus: Stimulus) -> BusLoad:
        """Return what the pixels that are not looked at send in a model; the last few are kept.

        A model becomes the present one several times over: descents begin at one place, and what its bus is
        like does not matter here.
        """
        bare = replace(sensor, effects=tuple(e for e in sensor.effects if not isinstance(e, StreamEffect)))
        found = next((load for load in self._loads if load.sensor == bare), None)
        if found is None:
            found = BusLoad(self, bare, stimulus)
        self._loads[:] = [found, *(load for load in self._loads if load is not found)][: self.kept]
        return found

    def others(self, chosen: NDArray[np.int32], steps: int, sent: int) -> NDArray[np.int32]:
        """Return those that are simulated to know what all send that are not looked at, sorted.

        Args:
            chosen: Those that are looked at, shape (N,).
            steps: Of the grid.
            sent: Events that those send.
        """
        rest = np.setdiff1d(np.arange(self.scene.width * self.scene.height, dtype=np.int32), chosen)
        by_events = int(self.most_events / max(sent, 1) * len(chosen))
        room = min(int(self.most_samples / steps), by_events) - len(chosen)
        few = max(len(chosen), room)
        if few >= len(rest):
            return rest
        # one of each stretch of pixels, so that all parts of the picture have their share
        ends = np.arange(few + 1) * len(rest) // few
        within = Draw.OTHER_PIXELS.generator(self.seed).random(few) * np.diff(ends)
        return rest[ends[:-1] + within.astype(np.int64)]

    def emitted(self, sensor: Sensor, pixels: NDArray[np.int32], steps: int, repeat: int = 0) -> Events:
        """Return what leaves some pixels in the first steps, in times [s] from the first sample on.

        Args:
            sensor: With the effects behind the pixels.
            pixels: Row-major indices, shape (N,).
            steps: Samples of the scene that are run.
            repeat: Each has random numbers of its own.
        """
        (events,) = SensorRun(
            self.scene, sensor, times=self.times[:steps], pixels=pixels, seed=self.seed + repeat,
            device=self.device,
        ).events()  # fmt: skip
        return replace(events, t=events.t - float(self.times[0]))


@dataclass(eq=False)
class BusLoad:
    """What the pixels that are not looked at send, as the present model has it.

    Worked out when it is first asked for: most models have no bus.

    Args:
        around: What all pixels see.
        sensor: The present model without what is behind the pixels.
        stimulus: The pixels that are looked at, and their time.
    """

    around: WholeSensor
    sensor: Sensor
    stimulus: Stimulus
    _before: dict[tuple[StreamEffect, ...], Others] = field(default_factory=dict, repr=False)

    def weight(self, events: Events) -> NDArray[np.float64]:
        """Return how many events one of the others stands for, shape (2,).

        Args:
            events: What leaves the pixels that are looked at in the model under trial. It sends more or less
                than the present one, and so it is taken to do everywhere.
        """
        _, counts, each = self._events
        return each * (_count_polarities(events) + 1) / (counts + 1)

    def others(self, effects: Iterable[StreamEffect], seed: int) -> Others:
        """Return the others' events behind some effects."""
        key = tuple(effects)
        if key not in self._before:
            events, until = self._events[0], np.inf
            for effect in key:
                reader = effect.reader(self.stimulus.width, self.stimulus.height, seed)
                events, until = reader.push(events, until)
            self._before[key] = Others.of(events)
        return self._before[key]

    @cached_property
    def _events(self) -> tuple[Events, NDArray[np.float64], float]:
        """The others' events, how many those looked at have, and how many of the others one stands for."""
        around, chosen, steps = self.around, self.stimulus.pixels, self.stimulus.grid.steps
        counts = [_count_polarities(around.emitted(self.sensor, chosen, steps))]
        sent = int(counts[0].sum())
        # of few events the number is chance, and with it the load of every model under trial
        repeats = min(math.ceil(around.counted / max(sent, 1)), around.repeats)
        for repeat in range(1, repeats):
            counts.append(_count_polarities(around.emitted(self.sensor, chosen, steps, repeat)))
        others = around.others(chosen, steps, sent)
        events = around.emitted(self.sensor, others, steps)
        each = (self.stimulus.width * self.stimulus.height - len(chosen)) / len(others)
        return events, np.mean(counts, axis=0), each


def _count_polarities(events: Events) -> NDArray[np.int64]:
    """Return the numbers of OFF and ON events."""
    on = np.count_nonzero(events.p)
    return np.array([len(events) - on, on])
