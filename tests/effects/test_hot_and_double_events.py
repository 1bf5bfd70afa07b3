"""Hot pixels that send at even intervals, and events that are sent twice."""

from __future__ import annotations

import zlib

import numpy as np
import pytest
from helpers.event_comparison import tracks
from helpers.readout_streams import bunched, camera, ns, same, through
from helpers.small_scenes import static
from reference import effects as reference_effects
from reference import readout as twin

import dase
from dase.effects.bandwidth import Bandwidth
from dase.effects.double_events import DoubleEvents
from dase.effects.hot import Hot
from dase.effects.jitter import Jitter
from dase.effects.leak import Leak
from dase.effects.mismatch import Mismatch
from dase.effects.refractory import Refractory
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold

# ---- hot pixels


@pytest.mark.parametrize(
    ("share", "rate", "balance"), [(0.3, 80.0, 0.7), (1.0, 300.0, 0.0), (1.0, 30.0, 1.0)]
)
def test_leaking_hot_pixels_send_one_polarity_at_even_intervals(device, share, rate, balance):
    seconds, pixels = 2.0, 900
    hot = Hot(share=share, rate=rate, spread=0.5, balance=balance, mode="leak")
    sensor = dase.Sensor((Threshold(on=0.2, off=0.3), hot))
    events = dase.simulate(static(np.full((30, 30), 0.3), seconds, 21), sensor, device=device)
    sending = [(t, events.p[events.y.astype(int) * 30 + events.x == i]) for i, t in enumerate(tracks(events))]
    sending = [(t, p) for t, p in sending if len(t) > 2]
    assert len(sending) / pixels == pytest.approx(
        share, abs=3.5 * np.sqrt(share * (1 - share) / pixels) + 1e-9
    )
    assert all(p.min() == p.max() for _, p in sending)
    on = np.mean([p[0] for _, p in sending])
    assert on == pytest.approx(balance, abs=3.5 * np.sqrt(balance * (1 - balance) / len(sending)) + 1e-9)
    for t, _ in sending:
        np.testing.assert_allclose(np.diff(t), np.diff(t).mean(), rtol=2e-3)
    # log-normal rates
    logs = np.log([1 / np.diff(t).mean() for t, _ in sending])
    assert np.median(logs) == pytest.approx(np.log(rate), abs=4 * 0.5 * 1.25 / np.sqrt(len(logs)))
    assert logs.std() == pytest.approx(0.5, rel=4 / np.sqrt(2 * len(logs)))


@pytest.mark.parametrize("more", [(), (Bandwidth(cutoff=80.0), Leak(rate=4.0, spread=0.2), Mismatch())])
@pytest.mark.parametrize("balance", [0.0, 0.5])
def test_leaking_hot_pixels_are_their_twin(device, rng, balance, more):
    times = np.linspace(0, 0.5, 200)
    level = np.cumsum(rng.normal(0, 0.05, (200, 4, 5)), 0) - 2
    scene = dase.VideoScene(np.exp(np.minimum(level, 0)).astype(np.float32), times)
    hot = Hot(share=0.7, rate=60.0, spread=0.3, balance=balance, mode="leak")
    sensor = dase.Sensor((Threshold(on=0.15, off=0.2), hot, *more))
    got = dase.simulate(scene, sensor, device=device)
    want = reference_effects.events(sensor, times, scene.frames(times), 0)
    place = got.y.astype(int) * 5 + got.x
    alike = []
    for i, rows in enumerate(want):
        mine = got.select(place == i)
        assert abs(len(mine) - len(rows)) <= 1
        alike.append(len(mine) == len(rows) and np.allclose(mine.t, rows[:, 1], rtol=0, atol=1e-4))
    assert np.mean(alike) >= 0.9


def test_a_dead_time_adds_to_their_intervals_and_jitter_scatters_them(device):
    scene = static(np.full((10, 10), 0.3), 2.0, 21)
    hot = Hot(share=1.0, rate=200.0, spread=0.0, balance=1.0, mode="leak")
    dead = dase.Sensor((Threshold(), hot, Refractory(period=2e-3, mode="reset")))
    for t in tracks(dase.simulate(scene, dead, device=device)):
        np.testing.assert_allclose(np.diff(t), 1 / 200 + 2e-3, rtol=2e-3)
    noisy = dase.Sensor((Threshold(), hot, Jitter(spread=0.1), Shot(rate=1e-3)))
    scatter = [
        np.diff(t).std() / np.diff(t).mean() for t in tracks(dase.simulate(scene, noisy, device=device))
    ]
    assert np.mean(scatter) == pytest.approx(0.1, rel=0.05)  # as those of a DAVIS240B: 0.07 to 0.21
    random = dase.Sensor((Threshold(), Hot(share=1.0, rate=200.0, spread=0.0)))
    scatter = [
        np.diff(t).std() / np.diff(t).mean() for t in tracks(dase.simulate(scene, random, device=device))
    ]
    assert np.mean(scatter) == pytest.approx(1.0, rel=0.05)


def test_no_hot_pixels_are_none_in_either_mode(device):
    scene, sensor = static(np.full((6, 6), 0.3), 1.0, 21), dase.Sensor((Threshold(), Shot(rate=30.0)))
    plain = dase.simulate(scene, sensor, device=device)
    for mode in ("noise", "leak"):
        got = dase.simulate(scene, sensor.with_effect(Hot(share=0.0, mode=mode)), device=device)
        np.testing.assert_array_equal(got.t, plain.t)
        np.testing.assert_array_equal(got.p, plain.p)


# ---- double events

DOUBLES = [
    DoubleEvents(share=0.3, on=0.2, delay=2e-6),
    DoubleEvents(share=0.9, delay=0.0, tail=4e-6),
    DoubleEvents(share=0.05, on=0.0, delay=6e-7, tail=1e-6),
    DoubleEvents(share=0.2, on=0.5, delay=2.3e-3, polarity="opposite"),
    DoubleEvents(share=0.3, delay=0.0, spread=3e-4),
]


@pytest.mark.parametrize("effect", DOUBLES, ids=repr)
@pytest.mark.parametrize("tick", [1, 2000])
def test_doubles_are_their_twin_however_the_stream_is_cut(rng, effect, tick):
    events = bunched(rng, 2000, tick)
    whole = through(camera(effect), events)
    draws = np.random.default_rng([0, zlib.crc32(b"double_events")]).random((len(events), 2))
    rows = list(
        zip(ns(events), events.x.tolist(), events.y.tolist(), events.p.astype(int).tolist(), strict=True)
    )
    shares = effect.share, effect.share * effect.on
    want = twin.doubled(
        rows, shares, 1e9 * effect.delay, 1e9 * effect.tail, draws, effect.polarity == "opposite",
        1e9 * effect.spread,
    )  # fmt: skip
    assert len(want) > len(events)
    got = zip(ns(whole), whole.x.tolist(), whole.y.tolist(), whole.p.astype(int).tolist(), strict=True)
    assert list(got) == want
    for count in (1, 5, 300):
        same(through(camera(effect), events, np.sort(rng.integers(0, len(events), count)).tolist()), whole)


@pytest.mark.parametrize("share", [0.02, 0.2])
def test_doubles_of_noisy_slow_pixels_count_in_the_rate(device, share):
    scene = static(np.full((20, 20), 0.5), 10.0, 21)
    pixels = dase.Sensor((Threshold(), Shot(rate=10.0, balance=0.3), Bandwidth(cutoff=100.0)))
    plain = dase.simulate(scene, pixels, device=device)
    got = dase.simulate(scene, pixels.with_effect(DoubleEvents(share=share, on=0.25)), device=device)
    off, on = (np.count_nonzero(plain.p == p) for p in (False, True))
    more = [np.count_nonzero(got.p == p) for p in (False, True)]
    assert more[0] - off == pytest.approx(share * off, abs=4 * np.sqrt(share * off))
    assert more[1] - on == pytest.approx(0.25 * share * on, abs=4 * np.sqrt(share * on))
    soon = np.concatenate([np.diff(t) for t in tracks(got)])
    assert np.count_nonzero(soon < 2e-6) == pytest.approx(sum(more) - off - on, rel=0.02)
    same_again = dase.simulate(scene, pixels.with_effect(DoubleEvents(share=share, on=0.25)), device=device)
    same(got, same_again) if got.label is not None else np.testing.assert_array_equal(got.t, same_again.t)
    none = dase.simulate(scene, pixels.with_effect(DoubleEvents.identity()), device=device)
    np.testing.assert_array_equal(none.t, plain.t)


def test_doubles_are_seen_by_the_events_alone():
    rng = np.random.default_rng(5)
    count = 60_000
    t = np.sort(rng.uniform(0, 2.0, count))
    x, y = rng.integers(0, 60, count), rng.integers(0, 45, count)
    events = dase.Events(t, x.astype(np.uint16), y.astype(np.uint16), rng.random(count) < 0.5, 60, 45)
    for effect, want in ((DoubleEvents(share=0.02), "double events"), (DoubleEvents.identity(), None)):
        found = dase.find_signatures(through(camera(effect), events)).found
        assert [one.name for one in found if one.name == "double events"] == ([want] if want else [])
