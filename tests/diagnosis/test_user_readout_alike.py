"""A user's clock, scan and bus, which share no class with dase's own, are treated as those are."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
import pytest
from helpers.brief_diagnosis import NO_LIMITS

import dase
from dase.diagnosis.diagnose import diagnose
from dase.diagnosis.distinguish import distinguish
from dase.diagnosis.explain_effect import moving_bars
from dase.effects import EFFECTS, Effect, Observations, StreamEffect, parameter
from dase.effects.readout import Bus, Readout
from dase.effects.row_scan import RowScan, Scan
from dase.effects.stream import StampPattern, random_numbers
from dase.effects.timestamp import Stamp, Timestamp
from dase.fitting.data_split import split_measurement
from dase.fitting.measurement import Measurement
from dase.simulation.sensor import Sensor

THRESHOLD = EFFECTS["threshold"](on=0.18, off=0.22)


@dataclass(frozen=True, kw_only=True)
class Ticker(StreamEffect):
    """A clock."""

    name: ClassVar[str] = "ticker"
    source: ClassVar[str] = "this test"

    grain: float = parameter(
        1e-6, unit="s", off=0.0, bounds=(0.0, 1.0), plausible=(1e-7, 1e-3), about="ticks", fitted=False
    )

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        return [cls(grain=observed.clock_period)] if observed.clock_period else []

    def longest_delay(self, lines: int) -> float:
        return self.grain

    def clock_period(self) -> float | None:
        return self.grain or None

    def stamp_pattern(self) -> StampPattern | None:
        return StampPattern(period=self.grain) if self.grain else None

    def reader(self, width: int, height: int, seed: int) -> Stamp:
        return Stamp(0.0, self.grain, random_numbers(seed, self.name))


@dataclass(frozen=True, kw_only=True)
class Sweep(StreamEffect):
    """A scan to the right."""

    name: ClassVar[str] = "sweep"
    source: ClassVar[str] = "this test"

    column: float = parameter(
        3e-7, unit="s", off=0.0, bounds=(0.0, 0.1), plausible=(3e-8, 3e-5), about="a column", fitted=False
    )

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        return [cls(column=observed.line_time)] if observed.scan_direction == "right" else []

    def longest_delay(self, lines: int) -> float:
        return lines * self.column

    def stamp_pattern(self) -> StampPattern | None:
        return StampPattern(line_time=self.column, direction="right")

    def reader(self, width: int, height: int, seed: int) -> Scan:
        return Scan(self.column, "right", width, height)


@dataclass(frozen=True, kw_only=True)
class Post(StreamEffect):
    """A bus."""

    name: ClassVar[str] = "post"
    source: ClassVar[str] = "this test"
    per_pixel: ClassVar[bool] = False

    pace: float = parameter(
        1e7, unit="Hz", off=np.inf, bounds=(1.0, np.inf), plausible=(5e5, 1e9), about="events", starts="above"
    )
    places: float = parameter(
        4096.0, unit="1", bounds=(1.0, np.inf), plausible=(1.0, 1e6), about="queue", fitted=False
    )

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        return [] if observed.bus_is_idle else [cls(pace=observed.highest_event_rate)]

    def is_idle(self, highest_rate: float) -> bool:
        return Readout(rate=self.pace, depth=self.places).is_idle(highest_rate)

    def for_share(self, share: float) -> Post:
        return replace(self, pace=self.pace * share, places=max(1.0, self.places * share))

    def reader(self, width: int, height: int, seed: int) -> Bus:
        return Readout(rate=self.pace, depth=self.places).reader(width, height, seed)


@dataclass(frozen=True, kw_only=True)
class OneMode(Readout):
    """The bus of dase without the mode that the test's bus lacks."""

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        return super().candidates(observed)[:1]


@pytest.mark.parametrize(
    ("hidden", "own", "users"),
    [
        pytest.param(Timestamp(step=5e-4, jitter=0.0), Timestamp, Ticker, id="clock", marks=pytest.mark.slow),
        pytest.param(
            RowScan(line=1e-5, direction="right"), RowScan, Sweep, id="scan", marks=pytest.mark.slow
        ),
        pytest.param(Readout(rate=2e5), OneMode, Post, id="bus", marks=pytest.mark.slow),
    ],
)
def test_a_users_readout_is_diagnosed_as_that_of_dase(hidden, own, users, device):
    scene = moving_bars(duration=0.3)
    events = dase.simulate(scene, Sensor((THRESHOLD,)).with_effect(hidden), seed=3, device=device)
    found = [
        diagnose(
            events, scene=scene, effects={"threshold": THRESHOLD.__class__, e.name: e},
            pixels=100, most=1, device=device, settings=NO_LIMITS,
        )
        for e in (own, users)
    ]  # fmt: skip
    # beside it nothing is tried: what the stamps show of dase's own clocks is tried by itself
    assert [f.selected for f in found] == [(own.name,), (users.name,)]
    if device == "cpu":
        one, two = found
        assert two.errors == one.errors
        assert two.evaluations == one.evaluations
        assert list(two.parameters.values()) == list(one.parameters.values())
        for a, b in zip(one.history, two.history, strict=True):
            assert a.families == b.families
            mine = [
                [(r.error, r.p_value, list(r.parameters.values())) for r in step.ranking] for step in (a, b)
            ]
            np.testing.assert_equal(*mine)  # NaN where a candidate was only screened


def test_kernels_stamp_by_a_users_clock(device):
    """As by the clock of dase, in a tenth of the time of a readout; nothing else is taken for one."""
    scene = moving_bars(duration=0.3)
    clock = Ticker(grain=5e-4)
    events = dase.simulate(scene, Sensor((THRESHOLD,)).with_effect(clock), seed=3, device=device)
    trials = split_measurement(Measurement(events, scene), pixels=64, device=device).scout.trials

    def ticks(*effects: Effect) -> float | None:
        return trials.ticks(Sensor((THRESHOLD, *effects)))

    assert ticks() == 0.0
    assert ticks(clock) == ticks(Timestamp(step=5e-4, jitter=0.0)) == 5e-4
    assert ticks(Ticker(grain=7e-4)) is None  # not at the ticks that were measured
    assert ticks(Timestamp(step=5e-4, jitter=1e-5)) is None
    assert ticks(clock, Sweep(column=1e-6)) is None
    assert ticks(Post(pace=1e5)) is None


def test_a_users_clock_is_distinguished_as_that_of_dase(device):
    ideal, answers = Sensor((THRESHOLD,)), []
    for clock in (Timestamp(step=1e-3, jitter=0.0), Ticker(grain=1e-3)):
        got = distinguish(ideal, ideal.with_effect(clock), longest=0.2, pixels=64, repeats=8, device=device)
        answers.append([(a.power, a.seconds, a.differs) for a in got.answers])
    assert max(power for power, _, _ in answers[0]) > 0.95
    if device == "cpu":
        assert answers[1] == answers[0]
