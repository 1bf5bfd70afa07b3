"""Streams: online equals stored, seeds, workers, what a batch says."""

from __future__ import annotations

import pickle
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from helpers.first_batches import FirstBatches

import dase
from dase.effects.latency import Latency
from dase.effects.readout import Readout
from dase.effects.vignetting import Vignetting
from dase.simulation.sensor_run import SensorRun
from dase.torch.augmentation import mirrored
from dase.torch.stream import BatchMaker

WINDOW = 1 / 60
NOISY = dase.load_sensor("davis240c")
SMALL = {"batch": 3, "steps": 3, "size": (32, 24), "backgrounds": 3, "objects": 6, "seed": 4, "renew": 0}
"""As little as shows everything: three slots of three windows."""


def streamed(*, device="cpu", **changes) -> dase.torch.Stream:
    return dase.torch.Stream("builtin", **{"sensor": NOISY, "device": device, **SMALL, **changes})


def stored(stream: dase.torch.Stream, number: int, slot: int, represent=None):
    """Return what `dase.simulate` gives for a slot of a batch: representations, frames, flow, events."""
    made, plan = stream.scene(number, slot), stream.plan
    sensor = dase.Sensor(
        tuple(e for e in made.sensor.effects if e.name not in stream.left_out), log_eps=made.sensor.log_eps
    )
    run = SensorRun(made.scene, sensor, times=made.times, seed=made.seed, pixels=made.pixels)
    events = run.events()[0]
    part = number % stream.scene_batches
    edges = WINDOW * np.arange((part + 1) * stream.steps + 1)
    width, height = plan.size
    x0, y0 = made.pixels[0] % plan.view[0], made.pixels[0] // plan.view[0]
    columns = events.t, events.x.astype(int) - x0, events.y.astype(int) - y0, events.p
    grids = (represent or stream.represent)(columns, edges=edges, size=plan.size)[-stream.steps :]
    ends = edges[-stream.steps :]
    frames = made.scene.frames(ends)[:, y0 : y0 + height, x0 : x0 + width]
    flow = made.scene.flow(ends)[..., y0 : y0 + height, x0 : x0 + width]
    return grids, frames, flow, len(events)


def assert_same(batch, stream, number, *, slots=(0, 1, 2), most=2e-3) -> None:
    """Assert that a batch is what is stored, but for what float32 rounds to another event."""
    total = 0
    for slot in slots:
        grids, frames, flow, events = stored(stream, number, slot)
        got = batch.inputs[:, slot].cpu().numpy()
        assert np.mean(np.abs(got - grids) > 2e-3 * max(1, np.abs(grids).max())) < most
        assert np.mean(np.abs(batch.frames[:, slot, 0].cpu().numpy() - frames) > 1e-4) < most
        wrong = np.abs(batch.flow[:, slot].cpu().numpy() - flow) > 1e-4 * max(1, np.abs(flow).max())
        # where the border of a thing passes through a pixel, float32 may see it on the other side
        assert wrong.mean() < 5e-3
        total += events
    assert total > 2000


def test_online_equals_stored(device):
    stream = streamed(device=device, randomise={"threshold.on": (0.1, 0.5), "shot.rate": (0.0, 5.0)})
    batch = next(iter(stream))
    assert_same(batch, stream, 0)
    assert batch.inputs.shape == (3, 3, 5, 24, 32)
    assert "  inputs  (3, 3, 5, 24, 32) float32" in repr(batch).splitlines()
    assert batch.frames.shape == (3, 3, 1, 24, 32)
    assert batch.flow.shape == (3, 3, 2, 24, 32)
    assert 0 <= batch.frames.min() < 0.5 < batch.frames.max() <= 1
    assert batch.reset.tolist() == [[True] * 3, [False] * 3, [False] * 3]
    on = batch.parameters["threshold.on"]
    assert torch.equal(batch.thresholds[:, 1], on)
    assert ((on > 0.1) & (on < 0.5)).all()
    assert len(set(on.tolist())) == 3
    assert torch.allclose(batch.thresholds[:, 0], torch.full_like(on, 0.2))


@pytest.mark.parametrize(
    "represent",
    [dase.CountImage(), dase.StackedHistogram(3), dase.TimeSurface(0.03), dase.EventFrame()],
    ids=lambda one: type(one).__name__,
)
def test_every_representation_online_equals_stored(device, represent):
    stream = streamed(device=device, represent=represent, batch=1)
    assert_same(next(iter(stream)), stream, 0, slots=(0,), most=5e-3)


def test_a_part_of_a_camera_that_goes_on_for_several_batches(device):
    """State is carried over; the place on the camera counts for vignetting and noise; light changes."""
    sensor = NOISY.with_effect(Vignetting(loss=0.5))
    stream = streamed(
        device=device, sensor=sensor, view=(60, 44), scene_batches=2, lighting=1.0, steps=2,
        regimes=("shake",), represent=dase.TimeSurface(0.05),
        augment=dase.torch.Augment(pause=0.3, paused=0.5),
    )  # fmt: skip
    batches = [batch for batch, _ in zip(stream, range(4), strict=False)]
    assert [bool(batch.reset[0].all()) for batch in batches] == [True, False, True, False]
    assert not any(batch.reset[1:].any() for batch in batches)
    for number in (1, 2):
        assert_same(batches[number], stream, number, most=1e-2)
    corners = {int(stream.scene(0, slot).pixels[0]) for slot in range(3)}
    assert len(corners) == 3
    paused = [stream.scene(n, slot).scene.camera.pauses for n in (0, 2) for slot in range(3)]
    assert any(paused)
    # begun in the middle of a scene
    again = next(iter(streamed(**{**vars_of(stream), "first_batch": 3, "device": device})))
    assert torch.equal(again.inputs, batches[3].inputs)
    assert torch.equal(again.flow, batches[3].flow)


def vars_of(stream) -> dict:
    plan = stream.plan
    names = ("view", "regimes", "lighting", "augment")
    return {name: getattr(plan, name) for name in names} | {
        "sensor": stream.sensor, "steps": stream.steps, "scene_batches": stream.scene_batches,
        "represent": stream.represent,
    }  # fmt: skip


def test_late_events_leave_in_later_batches(device):
    sensor = NOISY.with_effect(Latency(delay=0.02, light=0.5))
    stream = streamed(device=device, sensor=sensor, steps=2, batch=2, scene_batches=2)
    first, second = (batch for batch, _ in zip(stream, range(2), strict=False))
    assert_same(second, stream, 1, slots=(0, 1), most=5e-3)
    prompt = next(iter(streamed(device=device, steps=2, batch=2, scene_batches=2)))
    assert first.inputs.abs().sum() < 0.8 * prompt.inputs.abs().sum()


@pytest.mark.parametrize("windows", [1, 3])
def test_a_lens(device, windows, monkeypatch):
    """Whole pictures are rendered and blurred, some windows at a time; frames are those without the lens."""
    monkeypatch.setattr(dase.torch.stream, "MEMORY", windows * 4 * 2 * 16 * 44 * 34)
    blurred = NOISY.with_effect(dase.EFFECTS["optics_blur"](sigma=1.5)).with_effect(Latency(delay=0.004))
    stream = streamed(device=device, sensor=blurred, view=(44, 34), batch=2, lighting=1.0, scene_batches=2)
    first, second = (batch for batch, _ in zip(stream, range(2), strict=False))
    assert_same(first, stream, 0, slots=(0, 1), most=5e-3)
    assert_same(second, stream, 1, slots=(0, 1), most=5e-3)


def test_readout_effects_are_left_out():
    stream = streamed(sensor=NOISY.with_effect(Readout(rate=1e4)), batch=1, steps=1)
    assert set(stream.left_out) == {"readout", "timestamp"}
    assert_same(next(iter(stream)), stream, 0, slots=(0,))


def test_learned_thresholds(device, tmp_path):
    from dase.effects.learned_threshold import LearnedThreshold
    from dase.networks.threshold_network import NetworkShape, ThresholdNet
    from dase.networks.weights_file import save_net

    torch.manual_seed(0)
    net = ThresholdNet(NetworkShape(channels=4, depth=1), mu=0.2, sigma=0.05)
    with torch.no_grad():
        for parameter in net.unet.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    save_net(tmp_path / "net.safetensors", net)
    learned = LearnedThreshold(weights=str(tmp_path / "net.safetensors"))
    sensor = dase.load_sensor("ideal").with_effect(learned)
    stream = streamed(device=device, sensor=sensor, view=(40, 30), batch=2)
    batch = next(iter(stream))
    for slot in range(2):
        made = stream.scene(0, slot)
        # the middle frame of these samples, not of those that the scene would choose itself
        made.scene.sample_times = lambda times=made.times: times
        events = SensorRun(
            made.scene, made.sensor, times=made.times, seed=made.seed, pixels=made.pixels
        ).events()[0]
        x0, y0 = made.pixels[0] % 40, made.pixels[0] // 40
        columns = events.t, events.x.astype(int) - x0, events.y.astype(int) - y0, events.p
        want = dase.Voxels(5)(columns, edges=WINDOW * np.arange(4), size=(32, 24))
        assert np.mean(np.abs(batch.inputs[:, slot].cpu().numpy() - want) > 2e-2) < 5e-3
        assert np.abs(want).sum() > 300
    plain = next(iter(streamed(device=device, sensor="ideal", view=(40, 30), batch=2)))
    assert (plain.inputs != batch.inputs).float().mean() > 0.05


def test_the_same_seed_gives_the_same_batches():
    first = [batch for batch, _ in zip(streamed(batch=2, renew=2), range(3), strict=False)]
    again = [batch for batch, _ in zip(streamed(batch=2, renew=2), range(3), strict=False)]
    for a, b in zip(first, again, strict=True):
        assert torch.equal(a.inputs, b.inputs)
        assert torch.equal(a.frames, b.frames)
        assert torch.equal(a.flow, b.flow)
    assert not torch.equal(first[0].inputs, first[1].inputs)
    other = next(iter(streamed(batch=2, renew=2, seed=5)))
    assert not torch.equal(first[0].inputs, other.inputs)
    # whatever came before: pools, too, are drawn from their number
    assert torch.equal(next(iter(streamed(batch=2, renew=2, first_batch=2))).inputs, first[2].inputs)


@pytest.mark.filterwarnings("ignore:This DataLoader will create")  # where the machine has one processor
@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_workers(method):
    """Several processes give the batches of one, in the same order."""
    stream, workers = streamed(batch=1, steps=2, sensor="ideal"), 2 if method == "fork" else 1
    want = list(FirstBatches(stream, 4))
    # with an end: a worker that PyTorch stops while it sends a batch aborted once, after all had come
    loader = torch.utils.data.DataLoader(
        FirstBatches(stream, 4 // workers), batch_size=None, num_workers=workers,
        multiprocessing_context=method, prefetch_factor=1,
    )  # fmt: skip
    for a, b in zip(want, loader, strict=True):
        assert torch.equal(a.inputs, b.inputs)
        assert torch.equal(a.reset, b.reset)


def test_scenes_that_go_on_want_one_worker(monkeypatch):
    """Asked as in a worker: real ones that fail would be waited for."""
    worker = SimpleNamespace(id=0, num_workers=2)
    monkeypatch.setattr(dase.torch.stream, "get_worker_info", lambda: worker)
    with pytest.raises(dase.InputError, match="need one worker, got num_workers=2"):
        iter(streamed(batch=1, steps=1, sensor="ideal", scene_batches=2))


def test_a_stream_can_be_sent():
    stream = streamed(batch=1, steps=1, sensor="ideal")
    again = pickle.loads(pickle.dumps(stream))
    assert torch.equal(next(iter(again)).inputs, next(iter(stream)).inputs)


def test_augmentations():
    plain = next(iter(streamed(sensor="ideal")))
    how = dase.torch.Augment(flips=0.5, noise=0.1, hot=0.2)
    stream = streamed(sensor="ideal", augment=replace(how, noise=0.0, hot=0.0))
    batch = next(iter(stream))
    flips = torch.tensor([stream.scene(0, slot).flips for slot in range(3)])
    assert flips.any()
    assert not flips.all()
    back = mirrored(batch, flips)
    for name in ("inputs", "frames", "flow"):
        assert torch.equal(getattr(back, name), getattr(plain, name))
    noisy = next(iter(streamed(sensor="ideal", augment=how)))
    added = (noisy.inputs - batch.inputs).std(0)
    assert 0.08 < float(added.median()) < 0.12
    again = next(iter(streamed(sensor="ideal", augment=how)))
    assert torch.equal(again.inputs, noisy.inputs)
    hot = next(iter(streamed(sensor="ideal", augment=dase.torch.Augment(hot=0.2)))).inputs - plain.inputs
    assert 0.005 < float((hot != 0).float().mean()) < 0.2
    assert torch.allclose(hot[0], hot[-1], atol=1e-5)


def test_a_mirrored_flow_points_the_other_way():
    flow = torch.zeros(1, 2, 2, 3, 4)
    flow[0, :, 0, 1, 0], flow[0, :, 1, 1, 0] = 5.0, 7.0
    batch = dase.torch.Batch(
        torch.zeros(1, 2, 1, 3, 4), torch.zeros(1, 2, 1, 3, 4), flow, torch.zeros(1, 2), torch.zeros(2, 2)
    )
    got = mirrored(batch, torch.tensor([[True, False], [False, True]])).flow
    assert got[0, 0, :, 1, 3].tolist() == [-5.0, 7.0]
    assert got[0, 1, :, 1, 0].tolist() == [5.0, -7.0]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"represent": dase.AveragedTimeSurface(0.1)}, "AveragedTimeSurface needs whole events"),
        ({"randomise": {"threshold.om": (0, 1)}}, "no parameter 'threshold.om': did you mean 'threshold.on'"),
        ({"regimes": ("fastt",)}, "there is no regime 'fastt': did you mean 'fast'"),
        ({"regimes": ()}, "at least one regime"),
        ({"size": (64, 24), "view": (60, 60)}, "size must lie in 1x1 to the view, 60x60, got 64x24"),
        ({"window": 0.0}, "window must be a number > 0 s"),
        ({"steps": 0}, "steps must be a whole number >= 1"),
        ({"device": "tpu0"}, "there is no device 'tpu0'"),
    ],
)
def test_refusals(changes, sentence):
    with pytest.raises(dase.InputError, match=sentence):
        streamed(**changes)


def test_memory_stays():
    """What a batch needs is used again by the next one, and batches that nobody keeps are given back."""
    resource = pytest.importorskip("resource")
    batches = iter(streamed(batch=1, steps=2, size=(128, 96), sensor="ideal"))
    for _ in range(5):
        batch = next(batches)
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(40):
        batch = next(batches)
    size = batch.inputs.nbytes + batch.frames.nbytes + batch.flow.nbytes
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - most
    assert 1024 * grown < 10 * size < 40 * size


def test_pictures_rendered_first_give_the_same_batches(monkeypatch):
    """As a GPU works: some windows at a time, light between two kernels; learned maps beside them."""
    plain = [b for b, _ in zip(streamed(view=(44, 34), scene_batches=2), range(2), strict=False)]
    begin = BatchMaker.__init__

    def renders_first(self, stream):
        begin(self, stream)
        self._rendering = True

    monkeypatch.setattr(BatchMaker, "__init__", renders_first)
    monkeypatch.setattr(dase.torch.stream, "GPU_MEMORY", 2 * 4 * 3 * 16 * 32 * 24)  # two windows
    first = [b for b, _ in zip(streamed(view=(44, 34), scene_batches=2), range(2), strict=False)]
    for a, b in zip(plain, first, strict=True):
        assert torch.equal(a.frames, b.frames)
        assert torch.equal(a.flow, b.flow)
        # a window is cut out of the samples of its launch, whose times are rounded
        assert ((a.inputs - b.inputs).abs() > 1e-4).float().mean() < 1e-4
        assert a.inputs.abs().sum() > 500
