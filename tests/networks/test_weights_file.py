"""Files of weights: written the same each time, and refused where no network is in them."""

from __future__ import annotations

import json

import pytest

from dase.errors import InputError

pytest.importorskip("safetensors", reason="needs safetensors, of the extra `learn`")

from safetensors.torch import save

from dase.networks import weights_file
from dase.networks.threshold_network import NetworkShape, ThresholdNet


def test_files_of_the_same_weights_are_the_same(tmp_path):
    """To the byte, and whoever may read other files written here may read them."""
    net = ThresholdNet(NetworkShape(channels=4, depth=1, table=(2, 2), split=True), mu=0.25, sigma=0.05)
    written = []
    for n in range(8):
        path = tmp_path / f"{n}.safetensors"
        weights_file.save_net(path, net)
        written.append(path.read_bytes())
    assert len(set(written)) == 1
    (tmp_path / "other").write_text("x")
    assert path.stat().st_mode == (tmp_path / "other").stat().st_mode


def test_what_no_network_has_is_refused(tmp_path):
    def put(text):
        (tmp_path / "w.safetensors").write_bytes(save({}, {weights_file.KIND: text}))
        return tmp_path / "w.safetensors"

    for shape, match in (
        ({"depth": 10_000}, "depth must be a whole number"),
        ({"channels": 10**9}, "channels must be a whole number"),
        ({"depth": 2.5}, "depth must be a whole number"),
        ({"table": [10**6, 10**6]}, "table must be a whole number"),
        ({"pattern": [10**9, 2]}, "pattern must be a whole number"),
        ({"pattern": 5}, "pattern must be two"),
        ({"split": 5}, "split must be true or false"),
        ({"channels": 1024, "depth": 8}, "does not hold the weights of the network that it says"),
        ([1, 2], "must be a table"),
        ("a", "must be a table"),
    ):
        with pytest.raises(InputError, match=match):
            weights_file.load_net(put(json.dumps(shape)))
    with pytest.raises(InputError, match="nested too deeply"):
        weights_file.load_net(put("[" * 100_000))
    net = ThresholdNet(NetworkShape(channels=4, depth=2))
    weights_file.save_net(tmp_path / "good.safetensors", net)
    assert weights_file.load_net(tmp_path / "good.safetensors").shape == net.shape
    pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 12345\n"
    (tmp_path / "p.safetensors").write_text(pointer)
    with pytest.raises(InputError, match="Git LFS pointer"):
        weights_file.load_net(tmp_path / "p.safetensors")


def test_metadata_of_weights_that_are_a_list(tmp_path):
    for metadata in ([1], {"a": [1]}, 5, {weights_file.KIND: 5}):
        head = json.dumps({"__metadata__": metadata}).encode()
        (tmp_path / "w.safetensors").write_bytes(len(head).to_bytes(8, "little") + head)
        with pytest.raises(InputError, match="does not hold learned thresholds"):
            weights_file.load_net(tmp_path / "w.safetensors")
