"""A lamp that lights a part of the picture is told, and its place is not compared."""

from dataclasses import replace

import numpy as np
import pytest

import dase
from dase.diagnosis import lamp_in_part
from dase.diagnosis.lamp_in_part import LAMP, find_lamp_in_part
from dase.effects import EFFECTS
from dase.effects.flicker import Flicker
from dase.effects.hot import Hot
from dase.effects.leak import Leak
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold
from dase.fitting.measurement import Measurement
from dase.results import Grade
from dase.scenes.video import VideoScene
from dase.signatures.kinds import FLICKER

WIDTH, HEIGHT = 96, 72
CENTRE, RADIUS = (28, 44), 14.0
PIXELS = dase.Sensor((Threshold(on=0.2, off=0.2),))
Y, X = np.mgrid[:HEIGHT, :WIDTH]
PLACE = (X - CENTRE[0]) ** 2 + (Y - CENTRE[1]) ** 2 <= RADIUS**2


def frames_at(times):
    """A picture that drifts to the right, at times [s], shape (T, H, W)."""
    rng = np.random.default_rng(17)
    coarse = rng.random((10, 24))
    wide = np.kron(coarse, np.ones((9, 9)))
    wide = sum(np.roll(wide, (i, j), (0, 1)) for i in range(4) for j in range(4)) / 16
    out = []
    for t in times:
        whole, part = divmod(26.0 * t, 1.0)
        here = (1 - part) * np.roll(wide, int(whole), 1) + part * np.roll(wide, int(whole) + 1, 1)
        out.append(0.2 + 0.6 * here[:HEIGHT, 30 : 30 + WIDTH])
    return np.array(out, np.float32)


@pytest.fixture(scope="module")
def clip():
    times = np.arange(0.0, 1.0, 4e-3)
    return VideoScene(frames_at(times), times)


def measured(clip, *, depth, frequency=100.0, place=PLACE, effects=()):
    """Events under a lamp, which the clip lacks."""
    times = np.arange(0.0, 0.99, 1e-3)
    light = frames_at(times)
    wave = 1 + depth * np.sin(2 * np.pi * frequency * times)
    light = np.where(place, light * wave[:, None, None].astype(np.float32), light)
    events = dase.simulate(VideoScene(light, times), dase.Sensor((*PIXELS.effects, *effects)), seed=5)
    return Measurement(events, clip)


@pytest.mark.parametrize("frequency", [100.0, 117.0])
def test_a_lamp_in_a_part_is_told_with_its_tone_and_place(clip, frequency):
    lamp = find_lamp_in_part(measured(clip, depth=0.35, frequency=frequency), log_eps=0.01)
    assert lamp is not None
    assert lamp.entry.name == FLICKER
    assert lamp.entry.details["frequency"] == pytest.approx(frequency, abs=0.5)
    assert not lamp.lights_all()
    assert (lamp.place & PLACE).sum() > 0.9 * PLACE.sum()
    y, x = np.nonzero(lamp.place)
    assert np.hypot(x.mean() - CENTRE[0], y.mean() - CENTRE[1]) < 6


def test_a_lamp_over_most_of_the_array_lights_all_of_it(clip):
    lamp = find_lamp_in_part(measured(clip, depth=0.4, place=np.ones_like(PLACE)), log_eps=0.01)
    assert lamp is not None
    assert lamp.lights_all()


@pytest.mark.parametrize(
    "effects",
    [(), (Shot(rate=10.0),), (Leak(rate=5.0),), (Hot(share=2e-3, rate=300.0),)],
    ids=lambda effects: "+".join(e.name for e in effects) or "plain",
)
def test_without_a_lamp_none_is_seen(clip, effects):
    assert find_lamp_in_part(measured(clip, depth=0.0, effects=effects), log_eps=0.01) is None


def test_a_tone_of_the_frames_or_of_the_light_is_no_lamp(clip):
    at_frames = measured(clip, depth=0.4, frequency=125.0)  # half of the rate of the clip's frames
    assert find_lamp_in_part(at_frames, log_eps=0.01) is None
    # bars that come by 100 times per second, which the clip shows
    times = np.arange(0.0, 0.99, 1e-3)
    bars = 0.5 + 0.3 * np.sin(2 * np.pi * (X / 12.0 - 100.0 * times[:, None, None]))
    scene = VideoScene(np.where(PLACE, bars, frames_at(times)).astype(np.float32), times)
    passing = Measurement(dase.simulate(scene, PIXELS, seed=5), scene)
    assert find_lamp_in_part(passing, log_eps=0.01) is None


def test_a_tone_that_counts_alone_have_is_no_lamp(clip):
    """Frames at 640 Hz looked like a lamp of 360 Hz, certain, in counts of 1 ms."""
    times = np.arange(0.0, 0.6, 2.5e-4)
    wave = 1 + 0.4 * np.sin(2 * np.pi * 640.0 * times)
    light = np.where(PLACE, frames_at(times) * wave[:, None, None].astype(np.float32), frames_at(times))
    fast = Measurement(dase.simulate(VideoScene(light, times), PIXELS, seed=5), clip)
    assert find_lamp_in_part(fast, log_eps=0.01) is None
    counted = find_lamp_in_part(fast, log_eps=0.01, settings=replace(LAMP, at_their_times=0.0))
    assert counted is not None
    assert counted.entry.details["frequency"] == pytest.approx(360.0, abs=0.5)


def test_where_the_strongest_tone_is_of_the_light_no_other_is_a_lamp(clip, monkeypatch):
    """What comes by each 30 ms had a tone of 100 Hz in its light, and others in its events alone."""
    two = Measurement(dase.simulate(_with_second_tone(), PIXELS, seed=5), clip)
    asked = []

    def swing(self, frequency):
        asked.append(frequency)
        return 1.0 if len(asked) == 1 else 0.0

    monkeypatch.setattr(lamp_in_part._LightChange, "swing", swing)
    assert find_lamp_in_part(two, log_eps=0.01) is None
    assert len(asked) == 1
    lamp = find_lamp_in_part(two, log_eps=0.01)
    assert lamp is not None
    assert lamp.entry.details["frequency"] == asked[0] == asked[1]


@pytest.mark.parametrize(("frequency", "is_so"), [(140.0, True), (139.6, True), (144.0, False), (20.0, True)])
def test_multiples_of_a_rate_at_which_light_goes_to_and_fro_are_the_scenes(clip, frequency, is_so):
    """Pixels that see a patch swing at 10 Hz together sent at 140 Hz, too, which had been a lamp, certain."""
    times = np.arange(0.0, 1.0, 2e-3)
    light = frames_at(times)
    patch = np.exp(-1.5 + 1.2 * np.sin(2 * np.pi * 10.0 * times))
    light[:, PLACE] = patch[:, None]
    to_and_fro = Measurement(dase.Events.empty(WIDTH, HEIGHT), VideoScene(light, times))
    change = lamp_in_part._LightChange.of(to_and_fro, PLACE, log_eps=1e-3)
    assert change.has_multiple(frequency, lamp_in_part.LAMP) is is_so
    rest = lamp_in_part._LightChange.of(to_and_fro, ~PLACE, log_eps=1e-3)
    assert not rest.has_multiple(frequency, lamp_in_part.LAMP)
    few = VideoScene(light[:5], times[:5])
    short = lamp_in_part._LightChange.of(Measurement(to_and_fro.events, few), PLACE, log_eps=1e-3)
    assert not short.has_multiple(frequency, lamp_in_part.LAMP)


def _with_second_tone():
    """Light under a lamp of 90 Hz, and of 140 Hz at another place."""
    times = np.arange(0.0, 0.99, 1e-3)
    light = frames_at(times)
    other = (X - 70) ** 2 + (Y - 20) ** 2 <= 14**2
    for place, depth, frequency in ((PLACE, 0.7, 90.0), (other, 0.45, 140.0)):
        wave = 1 + depth * np.sin(2 * np.pi * frequency * times)
        light = np.where(place, light * wave[:, None, None].astype(np.float32), light)
    return VideoScene(light, times)


def test_a_diagnosis_names_the_lamp_and_fits_the_rest_of_the_array(clip):
    library = {name: EFFECTS[name] for name in ("flicker", "mismatch")}
    measurement = measured(clip, depth=0.35)
    found = dase.diagnose(measurement, PIXELS, effects=library, pixels=300, seed=1)
    lamps = [one for one in found.findings if one.effect == "flicker"]
    assert [one.grade for one in lamps] == [Grade.CERTAIN]
    assert "around pixel" in lamps[0].seen
    assert len(found.findings) == 1
    assert found.selected == ()
    assert "flicker" not in found.sensor
    assert found.errors[-1] < found.gate
    assert any("under the lamp are not compared" in note for note in found.notes)
    assert found.sensor["threshold"].on == pytest.approx(0.2, rel=0.03)
    # a sensor with a lamp of its own is compared everywhere
    with_lamp = PIXELS.with_effect(Flicker(frequency=100.0, depth=0.1))
    given = dase.diagnose(measurement, with_lamp, effects=library, pixels=300, most=1, seed=1)
    assert not any("under the lamp" in note for note in given.notes)
