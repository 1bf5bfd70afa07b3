"""Nothing outside an HDF5 file is ever opened, and what links hide counts: each way a file may lead out."""

from __future__ import annotations

import struct
import sys
from contextlib import suppress

import h5py
import numpy as np
import pytest
from helpers import sample_files as reference_io
from helpers.call_counts import counting_calls
from helpers.watched_files import opens_of

from dase import io
from dase.errors import InputError

READERS = {
    "HDF5": ("events/ts", "images/image000000000", "flow/flow000000000", "dase/thresholds", "events/labels"),
    "DSEC": ("events/t", "events/x", "t_offset"),
    "MVSEC": ("davis/left/events", "davis/left/image_raw"),
    "v2e": ("events", "frame", "frame_ts"),
    "ECF": ("CD/events",),
}
"""Layouts, and the names that their readers ask for."""


def secret(folder):
    """A file that must not be read: what all names of all layouts would hold."""
    with h5py.File(folder / "secret.h5", "w") as file:
        file["numbers"] = np.arange(48 * 36, dtype=np.uint8).reshape(36, 48)
    return folder / "secret.h5"


def led_out(path, name, way, target):
    """Put at a name what leads to `target`: an external link, a link to one, or values that lie there."""
    with h5py.File(path, "a") as file:
        if name in file:
            shape, kind = file[name].shape, file[name].dtype
            del file[name]
        else:
            shape, kind = (36, 48), np.dtype("u1")
        group = file.require_group(name.rpartition("/")[0] or "/")
        leaf = name.rpartition("/")[2]
        if way == "external link":
            group[leaf] = h5py.ExternalLink(str(target), "/numbers")
        elif way == "soft link to one":
            file["elsewhere"] = h5py.ExternalLink(str(target), "/")
            group[leaf] = h5py.SoftLink("/elsewhere/numbers")
        elif way == "external storage":
            group.create_dataset(leaf, shape, kind, external=[(str(target), 0, h5py.h5f.UNLIMITED)])
        elif way == "virtual":
            layout = h5py.VirtualLayout(shape, kind)
            layout[...] = h5py.VirtualSource(str(target), "numbers", shape)
            group.create_virtual_dataset(leaf, layout)
        elif way == "folder is elsewhere" and "/" in name:
            top = name.partition("/")[0]
            del file[top]
            file[top] = h5py.ExternalLink(str(target), "/")


@pytest.mark.parametrize(
    "way", ["external link", "soft link to one", "external storage", "virtual", "folder is elsewhere"]
)
@pytest.mark.parametrize(
    ("layout", "name"), [(layout, name) for layout, names in READERS.items() for name in names]
)
def test_nothing_outside_the_file_is_opened(tmp_path, rng, monkeypatch, layout, name, way):
    suffix, make = reference_io.SAMPLES[layout]
    path, target = tmp_path / f"a{suffix}", secret(tmp_path)
    make(path, reference_io.events(rng, 300, 48, 36))
    led_out(path, name, way, target)
    opened = opens_of(target)
    with h5py.File(target):  # the watch works
        pass
    assert opened() or not sys.platform.startswith("linux")
    for act in (io.read, lambda one: list(io.stream(one)), lambda one: list(io.pictures(one))):
        with suppress(InputError):
            act(path)
        assert not opened()


@pytest.mark.parametrize("name", ["images/image000000001", "dase/thresholds"])
def test_what_an_external_link_holds_is_not_copied(tmp_path, rng, name):
    path, target = tmp_path / "a.h5", secret(tmp_path)
    reference_io.SAMPLES["HDF5"][1](path, reference_io.events(rng, 300, 48, 36))
    led_out(path, name, "external link", target)
    for act in (io.read, lambda one: io.convert(one, tmp_path / "b.h5")):
        with pytest.raises(InputError, match="link to another file"):
            act(path)
    assert not (tmp_path / "b.h5").exists()


def test_a_link_within_the_file_is_followed(tmp_path, rng):
    path = tmp_path / "a.h5"
    e = reference_io.events(rng, 300, 48, 36)
    reference_io.dsec(path, e)
    with h5py.File(path, "a") as file:
        file.move("events", "kept")
        file["events"] = h5py.SoftLink("/kept")
    assert np.array_equal(io.read(path, size=(48, 36)).events.x, e.x)


def test_links_in_circles_end(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["events"] = h5py.SoftLink("/events")
        for k in range(30):  # each twice the next: two to the thirtieth ways to walk
            file[f"link{k}"] = h5py.SoftLink(f"link{k + 1}/link{k + 1}")
        file["images"] = h5py.SoftLink("/link0")
    with counting_calls() as counted, pytest.raises(InputError, match="link to a link"):
        io.read(tmp_path / "a.h5")
    assert counted.calls < 50_000


@pytest.mark.slow
def test_many_names_of_one_image_count_as_many(tmp_path, rng):
    path = tmp_path / "a.h5"
    reference_io.SAMPLES["HDF5"][1](path, reference_io.events(rng, 300, 48, 36))
    with h5py.File(path, "a") as file:
        large = file.create_dataset("large", (2000, 2000), np.uint8, data=np.zeros((2000, 2000), np.uint8))
        large.attrs["timestamp"] = 0.0
        for k in range(3000):
            file[f"images/image{k:09d}"] = large
    for act in (io.read, lambda one: list(io.pictures(one)), lambda one: list(io.stream(one))):
        with counting_calls() as counted, pytest.raises(InputError, match=r"unpacks from .* to 12000 MB"):
            act(path)
        assert counted.calls < 3000 * 500


@pytest.mark.parametrize("group", ["images", "flow"])
def test_a_dataset_in_place_of_a_group_is_refused_before_it_is_read(tmp_path, rng, group):
    path = tmp_path / "a.h5"
    reference_io.SAMPLES["HDF5"][1](path, reference_io.events(rng, 300, 48, 36))
    with h5py.File(path, "a") as file:
        if group in file:
            del file[group]
        file.create_dataset(group, (1 << 40,), np.uint8, chunks=(1 << 20,))  # all zeros, stored in no bytes
    for act in (io.read, lambda one: list(io.pictures(one)), lambda one: list(io.stream(one))):
        with pytest.raises(InputError, match=f"'{group}' is a dataset"):
            act(path)


def test_groups_nested_deeply_take_no_time(tmp_path, rng):
    path = tmp_path / "a.h5"
    e = reference_io.events(rng, 300, 48, 36)
    reference_io.SAMPLES["HDF5"][1](path, e)
    with h5py.File(path, "a") as file:
        for top in ("dase", "other"):
            node = file.require_group(top)
            for _ in range(3000):
                node = node.create_group("g")
    with counting_calls() as counted:
        assert len(io.read(path).events) == len(e)
    assert counted.calls < 2 * 3000 * 200
    with h5py.File(path, "a") as file:
        for name in ("events", "images"):
            del file[name]
    with counting_calls() as counted, pytest.raises(InputError, match="no known layout"):
        io.read(path)
    assert counted.calls < 2 * 3000 * 200


def test_a_dataset_that_claims_more_than_the_file_has_is_refused(tmp_path, rng):
    path = tmp_path / "a.h5"
    e = reference_io.events(rng, 300, 48, 36)
    reference_io.dsec(path, e, chunks=(300,), compression="gzip", shuffle=True)
    data = bytearray(path.read_bytes())
    with h5py.File(path) as file:
        size = file["events/x"].id.get_chunk_info(0).size
        where = file["events/x"].id.get_chunk_info(0).byte_offset
    key = struct.pack("<II", size, 0)  # a key of the tree of chunks: u32 size, u32 filters left out
    place = data.find(struct.pack("<Q", where))
    at = data.rfind(key, 0, place)
    data[at : at + 4] = struct.pack("<I", 0xF0000000)
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"claims .* bytes of a file of"):
        io.read(path, size=(48, 36))
