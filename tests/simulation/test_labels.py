"""Labels say what an event came from: where it is known beyond doubt, and through files and readout."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, replace
from typing import ClassVar

import h5py
import numpy as np
import pytest
import warp as wp
from reference import pixel as reference

import dase
from dase import io
from dase.effects import Effect, parameter
from dase.effects.bandwidth import Bandwidth
from dase.effects.latency import Latency
from dase.effects.leak import Leak
from dase.effects.mismatch import Mismatch
from dase.effects.refractory import Refractory
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold
from dase.events import LABELS
from dase.io.sequence import Sequence
from dase.recordings import summary
from dase.recordings.statistics import sequence_statistics

SIGNAL, LEAK, SHOT, HOT = range(4)


def still(seconds: float = 8.0, samples: int = 81, light: float = 0.1) -> dase.VideoScene:
    frames = np.full((samples, 9, 10), light, np.float32)
    return dase.VideoScene(frames, np.linspace(0, seconds, samples))


def moving(rng: np.random.Generator, samples: int = 100) -> dase.VideoScene:
    level = -np.abs(np.cumsum(rng.normal(0, 0.25, (samples, 8, 9)), 0) + rng.uniform(-4, -0.5, (8, 9)))
    return dase.VideoScene(np.exp(level).astype(np.float32), np.cumsum(rng.integers(4, 24, samples)) / 4096)


def slope(change: float, pixels: int = 40, samples: int = 41) -> reference.LogScene:
    """Return pixels whose log intensity runs straight by `change` within a second."""
    level = np.linspace(-4, -4 + change, samples)[:, None, None] * np.ones((1, pixels))
    return reference.LogScene(level, np.linspace(0, 1, samples))


def noisy(mode: str = "reset") -> dase.Sensor:
    return reference.only(
        Mismatch(spread=0.1),
        Bandwidth(cutoff=400.0),
        Leak(rate=30.0, spread=0.3),  # the light leaves it the quiet pixels only
        Shot(rate=60.0),
        Refractory(period=3e-3, mode=mode),
        Latency(delay=2e-3),
        mode=mode,
    )


def labels(events: dase.Events) -> np.ndarray:
    """Return how many events have each label."""
    assert events.label is not None
    assert events.label.dtype == np.int8
    return np.bincount(events.label, minlength=len(LABELS))


def test_the_names_of_labels():
    assert LABELS == ("signal", "leak", "shot", "hot")


@pytest.mark.parametrize("phase", [0.0, 1.0])
def test_a_still_scene_with_leak(device, phase):
    # pixels that start close to a threshold too: light brought none of them there
    sensor = reference.only(Threshold(phase=phase), Leak(rate=3.0))
    got = labels(dase.simulate(still(), sensor, device=device, labels=True))
    assert got[LEAK] > 1000
    assert got[LEAK] == got.sum()


def test_a_still_scene_with_shot_noise(device):
    got = labels(dase.simulate(still(), reference.only(Shot(rate=8.0)), device=device, labels=True))
    assert got[SHOT] > 1000
    assert got[SHOT] == got.sum()


def test_a_still_scene_with_both(device):
    alone = dase.simulate(still(), reference.only(Shot(rate=8.0)), device=device)
    sensor = reference.only(Shot(rate=8.0), Leak(rate=12.0))
    both = dase.simulate(still(), sensor, device=device, labels=True)
    got = labels(both)
    assert got[SIGNAL] == got[HOT] == 0
    assert got[LEAK] > 1000
    shot = both.select(both.label == SHOT)
    for name in "txyp":
        np.testing.assert_array_equal(getattr(shot, name), getattr(alone, name))
    assert both.p[both.label == LEAK].all()


@pytest.mark.parametrize("mode", ["reset", "drop", "delay"])
def test_a_moving_scene_without_noise(device, rng, mode):
    sensor = reference.only(Mismatch(spread=0.2), Bandwidth(), Refractory(period=2e-3, mode=mode), mode=mode)
    got = labels(dase.simulate(moving(rng), sensor, device=device, labels=True))
    assert got[SIGNAL] > 1000
    assert got[SIGNAL] == got.sum()


@pytest.mark.parametrize(
    ("change", "leak", "want"),
    [
        (3.0, 1.0, SIGNAL),
        (1.05, 1.0, SIGNAL),
        (0.95, 1.0, LEAK),
        (0.3, 1.0, LEAK),
        (-0.5, 2.0, LEAK),
        (-3.0, 1.0, SIGNAL),
    ],
)
@pytest.mark.parametrize("phase", [0.0, 1.0])
@pytest.mark.parametrize("mode", ["reset", "drop", "delay"])
def test_the_greater_share_decides(device, change, leak, want, phase, mode):
    # light moves the pixel by `change` in a second, the leak by `leak`; ON events where the sum rises
    sensor = reference.only(
        Threshold(on=0.1, off=0.1, phase=phase), Leak(rate=leak / 0.1, spread=0.0), mode=mode
    )
    events = dase.simulate(slope(change), sensor, device=device, labels=True)
    assert len(events) >= 40 * (abs(change + leak) / 0.1 - 2)
    assert events.p.all() == (change + leak > 0)
    assert labels(events)[want] == len(events)


def test_crossings_lost_in_the_dead_time_end_the_account(device):
    # 5 thresholds per second by light, 1 by leak, one event per second: a sixth of each crossing is leak
    sensor = reference.only(
        Threshold(on=0.1, off=0.1, phase=0.0), Leak(rate=1.0, spread=0.0), Refractory(period=0.45)
    )
    events = dase.simulate(slope(0.5), sensor, device=device, labels=True)
    assert len(events) == 40 * 2
    assert labels(events)[SIGNAL] == len(events)


def test_a_shot_event_ends_the_account(device):
    # after 0.06 of leak a noise event; then 0.06 more of leak and 0.04 of light make an ON event
    @wp.func
    def once(t: float, rate: float):
        return wp.where(wp.abs(t - 0.6) < 0.011, rate, 0.0), 0.0

    @dataclass(frozen=True, kw_only=True)
    class Once(Effect):
        name: ClassVar[str] = "once"
        source: ClassVar[str] = "this test"
        stages: ClassVar = {"noise": once}
        rate: float = parameter(1.0, unit="Hz", off=0.0, bounds=(0.0, 1e9), plausible=(0.0, 1.0), about="")

    level = np.r_[np.full(31, -4.0), np.linspace(-4.0, -3.96, 21)[1:]]
    scene = reference.LogScene(level[:, None, None], np.arange(51) * 0.02)
    # leak 0.1 per second; the noise event at 0.6 s; ON at 0.9: 0.03 of leak and 0.03 of light
    quiet = Threshold(on=0.06, off=0.06, phase=0.0)
    sensor = dase.Sensor((quiet, Leak(rate=0.08 / 0.06, spread=0.0), Once(rate=1e4)))
    events = dase.simulate(scene, sensor, device=device, labels=True)
    noise = np.flatnonzero(events.label == SHOT)
    assert len(noise) > 5
    after = events.label[noise[-1] + 1 :]
    np.testing.assert_array_equal(after, [SIGNAL])


@wp.func
def burning(rate: float):
    return rate, 0.0


@dataclass(frozen=True, kw_only=True)
class Burning(Effect):
    """A noise effect that says what its events are."""

    name: ClassVar[str] = "burning"
    source: ClassVar[str] = "this test"
    label: ClassVar[str] = "hot"
    stages: ClassVar = {"noise": burning}
    rate: float = parameter(9.0, unit="Hz", off=0.0, bounds=(0.0, 1e5), plausible=(1.0, 1e3), about="")


def test_a_noise_effect_names_its_events(device):
    sensor = dase.Sensor((Threshold(), Shot(rate=5.0), Burning()))
    events = dase.simulate(still(), sensor, device=device, labels=True)
    got = labels(events)
    for label, rate in ((SHOT, 5.0 * (1 - 0.75 * 0.1)), (HOT, 9.0)):
        want = rate * 8.0 * 90
        assert got[label] == pytest.approx(want, abs=3 * np.sqrt(want))
    assert got[SIGNAL] == got[LEAK] == 0
    assert events.p[events.label == HOT].all()


@pytest.mark.parametrize("mode", ["reset", "drop", "delay"])
def test_labels_change_no_event(device, rng, mode):
    scene, sensor = moving(rng), noisy(mode)
    want = dase.simulate(scene, sensor, device=device)
    got = dase.simulate(scene, sensor, device=device, labels=True)
    assert want.label is None
    for name in "txyp":
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name))
    assert np.all(labels(got)[[SIGNAL, LEAK, SHOT]] > 10)
    for chunk in (1, 7, 64):
        parts = dase.Events.concatenate(dase.stream(scene, sensor, device=device, labels=True, chunk=chunk))
        np.testing.assert_array_equal(parts.label, got.label)


# ---- events and files


def some(rng: np.random.Generator, count: int = 500) -> dase.Events:
    t = np.sort(rng.integers(0, 10**6, count)) * 1e-6
    x, y = rng.integers(0, 7, count, np.uint16), rng.integers(0, 5, count, np.uint16)
    label = rng.choice(4, count, p=[0.7, 0.15, 0.1, 0.05]).astype(np.int8)
    return dase.Events(t, x, y, rng.random(count) < 0.5, 7, 5, label)


def test_events_keep_their_labels(rng):
    events = some(rng)
    part = events.slice(0.2, 0.4)
    np.testing.assert_array_equal(part.label, events.label[(events.t >= 0.2) & (events.t < 0.4)])
    np.testing.assert_array_equal(events.select(events.p).label, events.label[events.p])
    joined = dase.Events.concatenate([events, dase.Events.empty(7, 5), part])
    np.testing.assert_array_equal(joined.label, np.r_[events.label, part.label])
    assert dase.Events.concatenate([events, replace(events, label=None)]).label is None
    with pytest.raises(dase.InputError, match="label must have the shape"):
        replace(events, label=events.label[1:])


@pytest.mark.parametrize("suffix", ["h5", "npz"])
def test_files_keep_labels(tmp_path, rng, suffix):
    path = tmp_path / f"a.{suffix}"
    for events in (some(rng), some(rng).select(slice(0))):
        io.write(path, Sequence(events))
        got = io.read(path).events
        assert got.label is not None
        assert got.label.dtype == np.int8
        np.testing.assert_array_equal(got.label, events.label)
    io.write(path, Sequence(replace(some(rng), label=None)))
    assert io.read(path).events.label is None


@pytest.mark.parametrize("suffix", ["h5", "npz"])
def test_labels_for_all_events_or_none(tmp_path, rng, suffix):
    path = tmp_path / f"a.{suffix}"
    marked = some(rng)
    for with_label in (True, False):
        first, second = (marked, replace(marked, label=None))[:: 1 if with_label else -1]
        with io.create(path) as writer:
            writer.events(dase.Events.empty(7, 5))
            writer.events(first.slice(0.0, 0.4))
            writer.events(dase.Events.empty(7, 5))  # has no event that could lack a label
            with pytest.raises(dase.InputError, match="labels must come with all events or with none"):
                writer.events(second.slice(0.5, 0.9))
        assert (io.read(path).events.label is not None) == with_label


def test_labels_are_sorted_with_their_events(tmp_path, rng):
    events, path = some(rng), tmp_path / "a.h5"
    io.write(path, Sequence(events))
    back = np.arange(len(events))[::-1]
    with h5py.File(path, "r+") as file:
        for name in ("ts", "xs", "ys", "ps", "labels"):
            file[f"events/{name}"][:] = file[f"events/{name}"][:][back]
    got = io.read(path).events
    want = events.select(np.lexsort((back, events.t)))
    np.testing.assert_array_equal(got.t, want.t)
    np.testing.assert_array_equal(got.label, want.label)


def test_unknown_labels_are_refused(tmp_path, rng):
    path = tmp_path / "a.h5"
    io.write(path, Sequence(some(rng)))
    with h5py.File(path, "r+") as file:
        file["events/labels"][3] = 4
    message = r"a\.h5: labels must be whole numbers in 0\.\.3: signal, leak, shot, hot"
    with pytest.raises(dase.InputError, match=message):
        io.read(path)


# ---- the command line


def test_shares_add_up(rng):
    events = some(rng)
    statistics = sequence_statistics(Sequence(events))
    assert statistics.label_shares == pytest.approx(np.bincount(events.label, minlength=4) / len(events))
    assert sum(statistics.label_shares) == pytest.approx(1.0)
    said = dict(summary.statistics_table(statistics))["labels"]
    assert said.startswith("signal ")
    assert sum(float(part.split()[1]) for part in said.split(", ")) == pytest.approx(100, abs=0.2)
    assert "labels" not in dict(
        summary.statistics_table(sequence_statistics(Sequence(replace(events, label=None))))
    )


def run(*arguments: object) -> str:
    command = [sys.executable, "-c", "from dase.cli import main; main()", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_synth_marks_events_when_asked(tmp_path):
    sensor = tmp_path / "noisy.toml"
    sensor.write_text("[threshold]\n[leak]\nrate = 20.0\n[shot]\nrate = 50.0\n[row_scan]\n[timestamp]\n")
    options = ("--size", "32x24", "--duration", "0.1", "--sequences", "1", "--jobs", "1", "--sensor", sensor)
    run("synth", tmp_path / "plain", *options)
    run("synth", tmp_path / "marked", *options, "--labels")
    plain, marked = (io.read(tmp_path / name / "sequence_00000.h5").events for name in ("plain", "marked"))
    assert plain.label is None
    np.testing.assert_array_equal(plain.t, marked.t)
    assert np.all(labels(marked)[[SIGNAL, LEAK, SHOT]] > 10)
    assert "labels            signal " in run("show", tmp_path / "marked" / "sequence_00000.h5")
    assert "labels" not in run("show", tmp_path / "plain" / "sequence_00000.h5")
