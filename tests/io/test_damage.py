"""Files that are damaged or made to do harm are refused with a sentence, in little memory."""

from __future__ import annotations

import contextlib
import io as streams
import zipfile

import numpy as np
import pytest
from helpers.sample_files import NEEDS, SAMPLES, events, measured, mutated, sample

from dase import io
from dase.errors import InputError


def test_arrays_of_objects_are_never_unpickled(tmp_path):
    class Trap:
        def __reduce__(self):
            return (print, ("unpickled",))

    trap = np.array([Trap()] * 4, object)
    np.save(tmp_path / "a.npy", trap, allow_pickle=True)
    columns = {"t_us": trap, "x": [1] * 4, "y": [1] * 4, "p": [1] * 4, "wh": [2, 2]}
    np.savez(tmp_path / "a.npz", **columns)
    output = streams.StringIO()
    with contextlib.redirect_stdout(output):
        for name in ("a.npy", "a.npz"):
            for act in (io.read, lambda path: list(io.stream(path))):
                with pytest.raises(InputError, match="never unpickled"):
                    act(tmp_path / name)
    assert output.getvalue() == ""


def test_arrays_that_claim_more_than_they_hold(tmp_path):
    kind = [("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "?")]
    stream = streams.BytesIO()
    header = {
        "descr": np.lib.format.dtype_to_descr(np.dtype(kind)),
        "fortran_order": False,
        "shape": (10**12,),
    }
    np.lib.format.write_array_header_1_0(stream, header)
    (tmp_path / "a.npy").write_bytes(stream.getvalue() + bytes(100))
    with pytest.raises(InputError, match="does not fit its"):
        io.read(tmp_path / "a.npy")


@pytest.mark.parametrize("name", ["a.zip", "a.npz"])
def test_zip_bombs(tmp_path, name):
    member = "events.txt" if name == "a.zip" else "t_us.npy"
    with (
        zipfile.ZipFile(tmp_path / name, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open(member, "w") as file,
    ):
        if name == "a.npz":
            header = {"descr": "<i4", "fortran_order": False, "shape": (75 << 20,)}
            np.lib.format.write_array_header_1_0(file, header)
        for _ in range(300):
            file.write(bytes(1 << 20))
    assert (tmp_path / name).stat().st_size < 1 << 20
    for act in (io.read, lambda path: list(io.stream(path))):
        with pytest.raises(InputError, match=r"more than 100 times|does not|events"):
            act(tmp_path / name)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_file(tmp_path):
    """A file of five million events is converted by a process that may use little more than at its start."""
    script = """
import numpy as np
from dase import io
from dase.events import Events
t = np.arange(1 << 16) / 1e6
n = np.arange(1 << 16)
def part(k):
    return Events(t + k * 0.07, (n % 640).astype(np.uint16), (n % 480).astype(np.uint16), n % 2 > 0, 640, 480)
def convert(count, a, b):
    with io.create(a) as writer:
        for k in range(count):
            writer.events(part(k))
    with io.create(b) as writer:
        for events in io.stream(a, chunk=50_000):
            writer.events(events)
def converted_twice(pair):
    a, b = pair.split("|")
    convert(40, a, b)
    before = peak()
    convert(80, a, b)
    print(peak() - before)
apart(converted_twice)
"""
    pairs = (("a.raw", "b.dat"), ("b.dat", "a.raw"), ("a.raw", "c.h5"))
    grown = measured(script, *(f"{tmp_path / a}|{tmp_path / b}" for a, b in pairs))
    assert len(grown) == len(pairs)
    assert all(float(one) < 25.0 for one in grown)


def refusal(act, path):
    """What the user is told; None where the file could be read."""
    try:
        act(path)
    except InputError as error:
        return str(error)
    return None


@pytest.mark.parametrize("name", SAMPLES)
def test_damaged_files_give_a_sentence_or_events(tmp_path, rng, name):
    path = sample(tmp_path, name, events(rng, 300))
    inner = [path] if path.is_file() else sorted(p for p in path.iterdir() if p.is_file())
    contents = [file.read_bytes() for file in inner]
    for k in range(60 if name in NEEDS else 150):
        which = k % len(inner)
        inner[which].write_bytes(mutated(contents[which], rng))
        for act in (io.read, lambda path: list(io.stream(path, chunk=100))):
            sentence = refusal(act, path)
            assert sentence is None or (sentence.startswith(str(path)) and "\n" not in sentence)
        inner[which].write_bytes(contents[which])
    for length in np.linspace(0, len(contents[0]) - 1, 40, dtype=int):
        inner[0].write_bytes(contents[0][:length])
        with contextlib.suppress(InputError):
            io.read(path)
