"""Files that are whole but odd: HDF5 with links and nesting, texts with values that nobody expects."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import cv2
import h5py
import numpy as np
from helpers.sample_files import SAMPLES

TOML = """name = "odd"
size = [48, 36]
log_eps = 0.001

[threshold]
on = 0.2
off = 0.25

[refractory]
period = 1e-4

[[history]]
did = "added refractory"
error_before = 2.5
"""
VALUES = (
    *(
        "0",
        "-1",
        "1e300",
        "-1e300",
        "1e400",
        "nan",
        "inf",
        "99999999999999999999",
        "true",
        "null",
        '""',
        "[]",
        "{}",
    ),
    *(
        '"\\u001b[31m"',
        '"../../x"',
        '"/etc/x"',
        "[[[[1]]]]",
        "1.5",
        "2147483648",
        '"a\\u0000b"',
        '{"a": {"a": {}}}',
    ),
)
"""What takes the place of a value of a text."""


PLACES = re.compile(r'"[^"\n]*"|-?\d[\d.e-]*|\[[^\[\]]*\]')


def odd_text(text: str, rng: np.random.Generator) -> str:
    """Return a text of JSON or TOML with some values replaced, lines doubled, or brackets added."""
    for _ in range(rng.integers(1, 3)):
        kind = rng.integers(0, 6)
        begin = int(rng.integers(max(len(text) - 10_000, 1)))  # a part of what has become long is enough
        places = list(PLACES.finditer(text, begin, begin + 10_000)) if kind < 3 else []
        if places:
            found = places[int(rng.integers(len(places)))]
            value = (
                str(rng.choice(VALUES))
                if kind
                else text[found.start() : found.end()] * int(rng.integers(2, 200))
            )
            text = text[: found.start()] + value + text[found.end() :]
        elif kind == 3:
            lines = text.split("\n")
            at = int(rng.integers(len(lines)))
            lines[at:at] = [lines[at]] * int(rng.choice([1, 3, 1000]))
            text = "\n".join(lines)
        else:
            at, deep = int(rng.integers(len(text) + 1)), int(rng.choice([1, 5, 30_000]))
            mark = str(rng.choice(["[", "{", "a.", '"', "(", '{"a":', "'", "\\", "\0", "\x1b"]))
            text = text[:at] + mark * deep + text[at:]
    return text


def write_coco(path: Path) -> None:
    """Annotations of one picture, which lies in a folder beside them."""
    folder = path.parent / "pictures"
    folder.mkdir(exist_ok=True)
    cv2.imwrite(str(folder / "a.png"), np.random.default_rng(0).integers(0, 256, (60, 90, 3), np.uint8))
    square = [10.0, 10.0, 50.0, 10.0, 50.0, 50.0, 10.0, 50.0]
    common = {"image_id": 1, "area": 1600, "iscrowd": 0}
    content = {
        "images": [{"id": 1, "file_name": "a.png", "width": 90, "height": 60}],
        "annotations": [
            {"id": 7, "segmentation": [square], **common},
            {"id": 8, "segmentation": {"size": [60, 90], "counts": [600, 1000, 3800]}, **common},
        ],
    }
    path.write_text(json.dumps(content, indent=1))


def odd_weights(data: bytes, rng: np.random.Generator) -> bytes:
    """Return weights whose head, a JSON text behind its length, is odd."""
    length = int.from_bytes(data[:8], "little")
    head = odd_text(data[8 : 8 + length].decode(), rng).encode("utf-8", "surrogatepass")
    return len(head).to_bytes(8, "little") + head + data[8 + length :]


def tangled(data: bytes, target: Path, rng: np.random.Generator) -> bytes:
    """Put links, values that lie elsewhere, many names of one thing, and deep groups into an HDF5 file.

    Args:
        data: The file, of any layout.
        target: A file that must not be opened; links lead to it.
        rng: Random numbers.
    """
    # in memory: thousands of links one by one are as many system calls
    fapl = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    fapl.set_fapl_core(block_size=1 << 16, backing_store=False)
    fapl.set_fclose_degree(h5py.h5f.CLOSE_STRONG)
    fapl.set_file_image(data)
    opened = h5py.h5f.open(b"tangled", h5py.h5f.ACC_RDWR, fapl)
    with h5py.File(opened) as file:
        names: list[str] = []
        file.visit(names.append)
        for _ in range(rng.integers(1, 5)):
            name = names[int(rng.integers(len(names)))]
            with suppress(Exception):  # what an operation before it left may not let it
                OPERATIONS[int(rng.integers(len(OPERATIONS)))](file, name, target, rng)
        file.flush()
        # the image begins behind what a program of its own may have put before it
        return data[: opened.get_create_plist().get_userblock()] + opened.get_file_image()


def _external(file: h5py.File, name: str, target: Path, rng: np.random.Generator) -> None:
    del file[name]
    file[name] = h5py.ExternalLink(str(target), str(rng.choice(["/numbers", "/", "/none"])))


def _soft(file: h5py.File, name: str, target: Path, rng: np.random.Generator) -> None:
    to = str(rng.choice([name, "/", "/none", "/elsewhere/numbers", "/link0", "kept"]))
    file.move(name, f"kept{rng.integers(1 << 30)}")
    if "elsewhere" not in file:
        file["elsewhere"] = h5py.ExternalLink(str(target), "/")
        for k in range(20):
            file[f"link{k}"] = h5py.SoftLink(f"link{k + 1}/link{k + 1}")
    file[name] = h5py.SoftLink(to)


def _stored_elsewhere(file: h5py.File, name: str, target: Path, rng: np.random.Generator) -> None:
    if isinstance(file[name], h5py.Dataset):
        shape, kind = file[name].shape, file[name].dtype
        del file[name]
        file.create_dataset(name, shape, kind, external=[(str(target), 0, h5py.h5f.UNLIMITED)])


def _virtual(file: h5py.File, name: str, target: Path, rng: np.random.Generator) -> None:
    if isinstance(file[name], h5py.Dataset):
        shape, kind = file[name].shape, file[name].dtype
        del file[name]
        layout = h5py.VirtualLayout(shape, kind)
        layout[...] = h5py.VirtualSource(str(target), "numbers", shape)
        file.create_virtual_dataset(name, layout)


def _many_names(file: h5py.File, name: str, target: Path, rng: np.random.Generator) -> None:
    node = file[name].id
    parent = file[name].parent.id
    for k in range(int(rng.choice([2, 50, 3000]))):  # past the layers of h5py, which take ten times as long
        h5py.h5o.link(node, parent, b"image%09d" % (k + 100))


def _nested(file: h5py.File, name: str, target: Path, rng: np.random.Generator) -> None:
    node = file[name] if isinstance(file[name], h5py.Group) else file[name].parent
    inner = node.id
    for _ in range(int(rng.choice([3, 100, 1000]))):
        inner = h5py.h5g.create(inner, b"g%d" % rng.integers(1 << 30))
    h5py.h5o.link(file.id, inner, b"back")


def _huge(file: h5py.File, name: str, target: Path, rng: np.random.Generator) -> None:
    if isinstance(file[name], h5py.Dataset):
        kind, ndim = file[name].dtype, max(file[name].ndim, 1)
        del file[name]
        side = int(rng.choice([2, 1000, 1 << 20]))
        file.create_dataset(name, (side,) * ndim, kind, chunks=(min(side, 64),) * ndim, compression="gzip")


OPERATIONS: tuple[Callable[[h5py.File, str, Path, np.random.Generator], None], ...] = (
    *(_external, _soft, _stored_elsewhere, _virtual, _many_names, _nested, _huge),
)
LAYOUTS = ("HDF5", "DSEC", "MVSEC", "v2e", "ECF", "MATLAB 7.3")
"""Samples in HDF5 that `tangle` is for."""
assert set(LAYOUTS) <= set(SAMPLES)
