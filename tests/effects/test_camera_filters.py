"""Trail filter, anti-flicker filter and rate controller: their twins and their laws."""

from __future__ import annotations

import math
import zlib

import numpy as np
import pytest
from helpers.readout_streams import bunched, camera, ns, same, through
from helpers.small_scenes import static
from reference import pixel as reference
from reference import readout as twin

import dase
from dase.effects.anti_flicker import AntiFlicker
from dase.effects.bandwidth import Bandwidth
from dase.effects.flicker import Flicker
from dase.effects.rate_control import RateControl
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold
from dase.effects.trail_filter import TrailFilter

KEPT = {"trail": range(1, 2), "stc_cut": range(2, 3), "stc_keep": range(2, 10**6)}


def listed(events: dase.Events) -> list[twin.Event]:
    columns = ns(events), events.x.tolist(), events.y.tolist(), events.p.astype(int).tolist()
    return list(zip(*columns, strict=True))


def passing(effect: dase.Effect, events: dase.Events, seed: int = 0) -> np.ndarray:
    """Return of each event whether its twin passes it."""
    rows = listed(events)
    if isinstance(effect, TrailFilter):
        places = twin.places_in_bursts(rows, round(effect.threshold * 1e9))
        return np.array([place in KEPT[effect.mode] for place in places])
    if isinstance(effect, AntiFlicker):
        found = twin.flickering(rows, effect.low, effect.high, int(effect.start), int(effect.stop))
        return np.array(found) == (effect.mode == "band_pass")
    draws = np.random.default_rng([seed, zlib.crc32(b"rate_control")]).random(len(rows))
    most = effect.rate * effect.period
    return np.array(twin.within_rate(rows, round(most, 6), round(effect.period * 1e9), effect.drop, draws))


FILTERS = [
    *(TrailFilter(threshold=threshold, mode=mode) for threshold in (2e-5, 2e-4) for mode in KEPT),
    AntiFlicker(low=3e3, high=1e6, start=2, stop=1),
    AntiFlicker(low=2e4, high=1e6, start=3, stop=3, mode="band_pass"),
    *(RateControl(rate=rate, period=1e-5, drop=d) for rate in (1e6, 7e5) for d in ("even", "random", "last")),
]


@pytest.mark.parametrize("effect", FILTERS, ids=repr)
def test_a_filter_is_its_twin_however_the_stream_is_cut(rng, effect):
    events = bunched(rng, 2000)
    events = dase.Events(events.t, events.x // 4, events.y // 4, events.p, 13, 11, events.label)
    want = events.select(passing(effect, events))
    whole = through(camera(effect), events)
    same(whole, want)
    assert 50 < len(whole) < 0.98 * len(events)
    for count in (1, 5, 300):
        same(through(camera(effect), events, np.sort(rng.integers(0, len(events), count)).tolist()), whole)


@pytest.mark.parametrize(
    "effect", [TrailFilter(), AntiFlicker(high=1e5, low=1.0, start=1), RateControl(rate=2e4)]
)
def test_a_filter_works_on_what_leaves_noisy_slow_pixels(device, effect):
    times = np.linspace(0, 0.2, 401)
    level = np.sin(2 * np.pi * 60 * times)[:, None, None] * np.linspace(0.5, 1, 30).reshape(1, 5, 6) - 2
    scene = reference.LogScene(level, times)
    pixels = camera(Bandwidth(cutoff=100.0), Shot(rate=60.0))
    plain = dase.simulate(scene, pixels, device=device)
    got = dase.simulate(scene, pixels.with_effect(effect), device=device)
    want = plain.select(passing(effect, plain))
    np.testing.assert_array_equal(got.t, want.t)
    assert 0 < len(got) < len(plain)
    off = dase.simulate(scene, pixels.with_effect(type(effect).identity()), device=device)
    np.testing.assert_array_equal(off.t, plain.t)


@pytest.mark.parametrize("balance", [0.5, 0.8])
@pytest.mark.parametrize("threshold", [0.02, 0.1])
def test_shares_of_independent_events_that_pass_the_trail_filter(balance, threshold):
    rate, scene = 12.0, static(np.full((30, 30), 0.5), 20.0, 21)
    noise = Shot(rate=rate, bright=1.0, balance=balance)
    plain = dase.simulate(scene, reference.only(noise))
    joined = 1 - math.exp(-rate * threshold)
    shares = np.array([balance, 1 - balance])
    want = {
        "trail": 1 - (shares**2).sum() * joined,
        "stc_keep": (shares**2).sum() * joined,
        "stc_cut": (shares * shares * joined * (1 - shares * joined)).sum(),
    }
    for mode, share in want.items():
        got = dase.simulate(scene, reference.only(noise, TrailFilter(threshold=threshold, mode=mode)))
        error = math.sqrt(share * (1 - share) / len(plain))
        assert len(got) / len(plain) == pytest.approx(share, abs=4 * error)


@pytest.mark.parametrize(("frequency", "left"), [(100.0, False), (180.0, False), (30.0, True), (620.0, True)])
def test_lamps_of_the_band_are_left_out_after_start_periods(frequency, left):
    sensor = reference.only(Threshold(on=0.2, off=0.2, phase=1.0), Flicker(frequency=frequency, depth=0.5))
    scene = dase.VideoScene(np.full((6001, 8, 8), 0.3, np.float32), np.linspace(0, 0.3, 6001))
    plain = dase.simulate(scene, sensor)
    got = dase.simulate(scene, sensor.with_effect(AntiFlicker()))
    assert len(plain) > 500
    if left:
        np.testing.assert_array_equal(got.t, plain.t)
    else:
        # the seventh burst, which ends the sixth period, starts the filter; before it come OFF events
        assert 5.4 / frequency < got.t[-1] < 6.5 / frequency
        seen = plain.select(plain.t <= got.t[-1])
        assert len(got) >= 0.8 * len(seen)
        other = dase.simulate(scene, sensor.with_effect(AntiFlicker(mode="band_pass")))
        assert len(other) + len(got) == len(plain)


@pytest.mark.parametrize("drop", ["even", "random", "last"])
@pytest.mark.parametrize("load", [0.5, 1.5, 6.0])
def test_a_steady_stream_leaves_at_the_limit(rng, drop, load):
    rate, seconds = 1e6, 0.2
    count = rng.poisson(load * rate * seconds)
    t = np.sort(rng.uniform(0, seconds, count))
    x = rng.integers(0, 13, count).astype(np.uint16)
    events = dase.Events(t, x, x % 11, x > 6, 13, 11)
    got = through(camera(RateControl(rate=rate, period=2e-3, drop=drop)), events)
    settled = np.count_nonzero(got.t > 2e-3) / (seconds - 2e-3)  # the first period passes whole
    assert settled == pytest.approx(min(load, 1.0) * rate, rel=0.02)
    if drop == "last":
        assert np.histogram(got.t, np.arange(0, seconds, 2e-3))[0].max() <= 2000
    elif load > 1:
        # not all of a period's begin: its halves pass as many
        late = (got.t % 2e-3) > 1e-3
        assert late.mean() == pytest.approx(0.5, abs=0.02)


def test_a_sudden_stream_passes_for_one_period():
    t = 1e-3 + np.arange(20_000) * 1e-7
    x = (np.arange(20_000) % 13).astype(np.uint16)
    events = dase.Events(t, x, x % 11, x > 6, 13, 11)
    got = through(camera(RateControl(rate=1e6, period=2e-4)), events)
    counts = np.histogram(got.t, 1e-3 + 2e-4 * np.arange(11) - 1e-9)[0]
    assert counts[0] == 2000
    np.testing.assert_allclose(counts[1:], 200, atol=1)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: TrailFilter(threshold=-1.0), r"trail_filter\.threshold must lie in \[0, 10\] s"),
        (
            lambda: AntiFlicker(low=200.0, high=100.0),
            r"anti_flicker\.low must not exceed high, 100 Hz, got 200",
        ),
        (lambda: RateControl(rate=100.0, period=1e-3), r"must let an event pass in each period of 0\.001 s"),
    ],
)
def test_refusals_name_thing_rule_and_value(make, message):
    with pytest.raises(dase.InputError, match=message):
        make()
