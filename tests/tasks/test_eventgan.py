"""EventGAN, the study's baseline."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

import dase
from perf.experiments.downstream.eventgan import (
    EventGan,
    GanTraining,
    Generator,
    event_volumes,
    network_inputs,
    save_eventgan,
    train_eventgan,
)


def some_events(rng, count=4000, seconds=0.4, size=(20, 18)):
    t = np.sort(rng.uniform(0, seconds, count))
    return dase.Events(
        t,
        rng.integers(size[0], size=count),
        rng.integers(size[1], size=count),
        rng.random(count) < 0.7,
        *size,
    )


def test_volumes_of_events_become_exactly_the_inputs_of_networks(rng):
    events, times = some_events(rng), np.linspace(0, 0.4, 9)
    volumes = event_volumes(events, times)
    assert volumes.shape == (8, 18, 18, 20)
    assert float(volumes.float().sum()) == pytest.approx(len(events), rel=1e-3)
    on = float(volumes[:, 9:].float().sum())
    assert on == pytest.approx(events.p.sum(), rel=1e-3)
    real = dase.Voxels(5)(events, edges=times)
    np.testing.assert_allclose(network_inputs(volumes.float()).numpy(), real, atol=5e-3)  # of float16


@pytest.mark.slow
def test_a_generator_is_trained_on_what_is_between_its_frames(rng, tmp_path, monkeypatch):
    """A critic that scores how far volumes are from the real ones of those frames teaches the generator them.

    The adversary itself takes thousands of steps; whether pairs, crops, polarities and signs of the losses
    belong together is seen with one that is right from the beginning.
    """
    frames = np.full((9, 16, 16), 60, np.uint8)
    frames[1::2, :, 8:] += 100
    times = np.linspace(0, 0.8, 9)
    y, x = np.mgrid[0:16, 8:16].reshape(2, -1)
    t, up = np.repeat(times[:-1] + 0.05, len(x)), np.repeat(np.arange(8) % 2 == 0, len(x))
    events = dase.Events(t, np.tile(x, 8), np.tile(y, 8), up, 16, 16)

    class Knowing(torch.nn.Module):
        """Scores how much ON lies where frames rise and OFF where they fall."""

        def __init__(self):
            super().__init__()
            self.gain = torch.nn.Parameter(torch.ones(()))

        def forward(self, volumes, shown):
            change = (shown[:, 1:] - shown[:, :1]).sign()
            truth = torch.cat([-change, change], 1).clamp(min=0)
            totals = torch.stack([volumes[:, :9].sum(1), volumes[:, 9:].sum(1)], 1)
            return self.gain * (1 - (totals - truth).abs())

    monkeypatch.setattr("perf.experiments.downstream.eventgan.PatchCritic", Knowing)
    monkeypatch.setattr("perf.experiments.downstream.eventgan.CHANNELS", (8, 16, 16))
    settings = GanTraining(steps=700, batch=4, crop=(16, 16))
    found = train_eventgan(events, frames, times, "cpu", settings)
    assert found["scale"] == pytest.approx(1.0, abs=0.7)
    assert found["log"]["correlation"] > 0.2
    save_eventgan(tmp_path / "gan.pt", found)
    gan = EventGan(tmp_path / "gan.pt")
    shown = 2 * torch.from_numpy(np.stack([frames[0:2], frames[1:3]])).float() / 255 - 1
    rising, falling = gan.generator(shown).clamp(0, 1)
    for volumes, more, less in ((rising, slice(9, 18), slice(0, 9)), (falling, slice(0, 9), slice(9, 18))):
        assert volumes[more, :, 9:].mean() > 1.2 * volumes[less, :, 9:].mean()


def test_a_batch_gets_inputs_of_its_frames_and_keeps_the_rest(tmp_path):
    torch.manual_seed(0)
    generator = Generator()
    weights = {name: one.half() for name, one in generator.state_dict().items()}
    save_eventgan(tmp_path / "gan.pt", {"weights": weights, "scale": 3.0})
    remake = EventGan(tmp_path / "gan.pt")
    batch = next(iter(dase.torch.Stream("builtin", "esim", batch=2, steps=3, size=(24, 20), device="cpu",
                                        backgrounds=2, objects=2)))  # fmt: skip
    inputs = remake(batch)
    assert inputs.shape == batch.inputs.shape
    assert not inputs[0].any()  # no frame is known before it
    pair = 2 * torch.cat([batch.frames[1, 1], batch.frames[2, 1]])[None] - 1
    alone = network_inputs(3.0 * remake.generator(pair).clamp(0, 1))[0]
    torch.testing.assert_close(inputs[2, 1], alone, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(remake(batch), inputs)  # spectral norms do not move when it is used
