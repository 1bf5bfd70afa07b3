"""Evaluating on files in the layouts that people have, made here."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import h5py
import numpy as np
import pytest

torch = pytest.importorskip("torch")

import dase
from dase import io
from dase.errors import InputError
from dase.tasks.checkpoints import save_checkpoint
from dase.tasks.evaluation import evaluate, picture_metrics
from dase.tasks.event_networks import EvFlowNet, FireNet

WIDTH, HEIGHT, FLOW = 24, 20, (60.0, -30.0)
WINDOW = 1 / 30


@pytest.fixture
def sequence(rng):
    """Return 0.2 s of events with 6 frames and one flow everywhere."""
    t = np.sort(rng.uniform(0, 0.2, 2000))
    x, y = (rng.integers(n, size=2000).astype(np.uint16) for n in (WIDTH, HEIGHT))
    events = dase.Events(t, x, y, rng.random(2000) < 0.5, WIDTH, HEIGHT)
    frames = rng.integers(256, size=(6, HEIGHT, WIDTH)).astype(np.uint8)
    flow = np.broadcast_to(np.array(FLOW, np.float32)[:, None, None], (6, 2, HEIGHT, WIDTH)).copy()
    return io.Sequence(events, frames, 0.04 * np.arange(6.0), flow)


def constant(network, values, path):
    """Write a checkpoint of a network that always says the same."""
    with torch.no_grad():
        network.last.weight.zero_()
        network.last.bias.copy_(torch.tensor(values))
    optimizer = torch.optim.AdamW(network.parameters())
    save_checkpoint(path, network, network, optimizer, step=1, steps=1, window=WINDOW)
    return path


@pytest.fixture
def grey(tmp_path):
    return constant(FireNet(5, 2), [0.25], tmp_path / "grey.pt")


@pytest.fixture
def flowing(tmp_path):
    """Return a network that says the true flow, 2 and -1 px in 1/30 s, but for 1 px in x."""
    return constant(EvFlowNet(5, 2), [3.0, -1.0], tmp_path / "flow.pt")


def test_one_grey_beside_frames(sequence, grey, tmp_path):
    io.write(tmp_path / "a.h5", sequence)
    found = evaluate(grey, tmp_path / "a.h5", device="cpu", out=tmp_path / "out")
    real = sequence.frames[1:] / 255
    assert found.windows == 5
    assert found.metrics["mse"] == pytest.approx(((real - 0.25) ** 2).mean(), rel=1e-4)
    assert found.metrics["mse_affine"] == pytest.approx(real.var(axis=(1, 2)).mean(), rel=1e-4)
    assert "ms_ssim" not in found.metrics
    sheet = cv2.imread(str(tmp_path / "out" / "a.h5.png"))
    assert sheet.shape == (5 * HEIGHT, 2 * WIDTH, 3)
    assert np.array_equal(sheet[:HEIGHT, :WIDTH, 0], sequence.frames[1])
    assert (sheet[:, WIDTH:] == 64).all()
    video = cv2.VideoCapture(str(tmp_path / "out" / "a.h5.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 5
    assert "mse" in repr(found)
    json.dumps(found.to_json())


def test_windows_are_normalised_if_asked_for(sequence, tmp_path):
    torch.manual_seed(0)
    network = FireNet(5, 16)
    torch.nn.init.constant_(network.last.bias, 0.5)  # in [0, 1], where nothing is cut
    optimizer = torch.optim.AdamW(network.parameters())
    save_checkpoint(tmp_path / "net.pt", network, network, optimizer, step=1, steps=1, window=WINDOW)
    io.write(tmp_path / "a.h5", sequence)
    real = torch.from_numpy(sequence.frames[1:] / 255)
    found = {}
    for normalise in (False, True):
        windows = dase.Voxels(5, normalise)(sequence.events, edges=sequence.frame_times)
        with torch.no_grad():
            made = network.sequence(torch.from_numpy(windows)[:, None])[0][:, 0, 0].clamp(0, 1)
        found[normalise] = float(((made - real) ** 2).mean())
        judged = evaluate(tmp_path / "net.pt", tmp_path / "a.h5", device="cpu", normalise=normalise)
        assert judged.metrics["mse"] == pytest.approx(found[normalise], rel=1e-4)
    assert found[True] != pytest.approx(found[False], rel=2e-4)


def test_true_flow_of_files_of_dase(sequence, flowing, tmp_path):
    io.write(tmp_path / "a.h5", sequence)
    found = evaluate(flowing, tmp_path / "a.h5", device="cpu", out=tmp_path / "out")
    assert found.metrics["aee"] == pytest.approx(1.0, rel=1e-4)
    assert found.metrics["aee_zero"] == pytest.approx(5**0.5, rel=1e-4)
    assert found.metrics["outliers"] == 0
    assert found.metrics["fwl"] > 0
    assert (tmp_path / "out" / "a.h5.png").is_file()


def test_mvsec_with_its_ground_truth(sequence, flowing, grey, tmp_path):
    e = sequence.events
    with h5py.File(tmp_path / "in_data.hdf5", "w") as file:
        columns = np.stack([e.x, e.y, 1e3 + e.t, np.where(e.p, 1, -1)], 1)
        file["davis/left/events"] = columns
        file["davis/left/image_raw"], file["davis/left/image_raw_ts"] = (
            sequence.frames,
            1e3 + sequence.frame_times,
        )
    with h5py.File(tmp_path / "in_gt.hdf5", "w") as file:
        # displacements [px] from one moment to the next, 0.05 s
        file["davis/left/flow_dist"] = 0.05 * sequence.flow[:5]
        file["davis/left/flow_dist_ts"] = 1e3 + 0.05 * np.arange(5.0)
    options = {"device": "cpu", "size": (WIDTH, HEIGHT)}
    found = evaluate(flowing, tmp_path / "in_data.hdf5", **options)
    assert found.metrics["aee"] == pytest.approx(1.0, rel=1e-3)
    assert evaluate(grey, tmp_path / "in_data.hdf5", **options).windows == 5


def test_ijrr_frames_and_events_alone(sequence, flowing, grey, tmp_path):
    folder = tmp_path / "shapes"
    (folder / "images").mkdir(parents=True)
    e = sequence.events
    rows = zip(e.t, e.x, e.y, e.p, strict=True)
    (folder / "events.txt").write_text("".join(f"{t:.9f} {x} {y} {int(p)}\n" for t, x, y, p in rows))
    names = [f"images/frame_{k:08d}.png" for k in range(6)]
    for name, frame in zip(names, sequence.frames, strict=True):
        cv2.imwrite(str(folder / name), frame)
    times = zip(sequence.frame_times, names, strict=True)
    (folder / "images.txt").write_text("".join(f"{t:.6f} {name}\n" for t, name in times))
    made = evaluate(grey, folder, device="cpu")
    real = sequence.frames[1:] / 255
    assert made.metrics["mse"] == pytest.approx(((real - 0.25) ** 2).mean(), rel=1e-4)
    found = evaluate(flowing, folder, device="cpu")
    assert set(found.metrics) == {"fwl", "fwl_signed"}


def test_dsec_has_events_alone(sequence, flowing, grey, tmp_path):
    e = sequence.events
    with h5py.File(tmp_path / "events.h5", "w") as file:
        for name, values in (
            ("t", np.round(1e6 * e.t).astype(np.uint32)),
            ("x", e.x),
            ("y", e.y),
            ("p", e.p),
        ):
            file[f"events/{name}"] = values
        file["ms_to_idx"] = np.searchsorted(e.t, 1e-3 * np.arange(200))
        file["t_offset"] = np.int64(5)
    options = {"device": "cpu", "size": (WIDTH, HEIGHT)}
    assert evaluate(flowing, tmp_path / "events.h5", **options).metrics["fwl"] > 0
    made = evaluate(grey, tmp_path / "events.h5", out=tmp_path / "out", **options)
    assert made.metrics == {}
    assert made.windows == 5  # of 1/30 s, all shown


def test_an_offset_moves_the_windows(sequence, flowing, grey, tmp_path):
    late = replace(sequence, frame_times=sequence.frame_times - 0.01)
    io.write(tmp_path / "a.h5", sequence)
    io.write(tmp_path / "b.h5", replace(late, frame_times=late.frame_times + 0.02))
    one = evaluate(flowing, tmp_path / "a.h5", device="cpu").metrics
    assert evaluate(flowing, tmp_path / "b.h5", device="cpu").metrics != one
    assert evaluate(flowing, tmp_path / "b.h5", device="cpu", offset=-0.01).metrics == pytest.approx(one)


def test_refusals(sequence, grey, tmp_path):
    io.write(tmp_path / "a.h5", replace(sequence, frames=None, frame_times=None, flow=None))
    with pytest.raises(InputError, match="no frames with times to read an offset off"):
        evaluate(grey, tmp_path / "a.h5", offset=None, device="cpu")
    with pytest.raises(InputError, match="no such checkpoint"):
        evaluate(tmp_path / "none.pt", tmp_path / "a.h5", device="cpu")


def test_metrics_of_equal_pictures():
    picture = torch.rand(1, 1, 180, 180)
    found = picture_metrics(picture, picture)
    assert found["mse"] == found["mse_histogram"] == 0
    assert found["ssim"] == found["ms_ssim"] == pytest.approx(1)


def test_the_command(sequence, grey, tmp_path):
    from click.testing import CliRunner

    from dase.cli import dase_group

    io.write(tmp_path / "a.h5", sequence)
    words = ["evaluate", str(grey), str(tmp_path / "a.h5"), "-o", str(tmp_path / "out"), "--device", "cpu"]
    ran = CliRunner().invoke(dase_group, words)
    assert ran.exit_code == 0, ran.output
    assert "a.h5: reconstruction, 5 judged" in ran.output
    row = json.loads((tmp_path / "out" / "results.jsonl").read_text())
    assert row["mse"] == evaluate(grey, tmp_path / "a.h5", device="cpu").metrics["mse"]
    ran = CliRunner().invoke(dase_group, [*words, "--offset", "soon"])
    assert isinstance(ran.exception, InputError)
    assert "seconds or auto, got 'soon'" in str(ran.exception)
