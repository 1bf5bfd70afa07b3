"""Events of real recordings through other libraries and back: are they the same?

    python -m perf.experiments.round_trips.run --recordings FOLDER --others OTHER_ENVIRONMENT/bin/python

dase converts three recordings to every format that another library reads; that library reads them, writes
them in its own way, and dase reads that. The other environment has evlib (MIT), expelliarmus (GPL-2, for this
comparison only), h5py and NumPy. The tests ask `aedat`, `rosbags` and `hdf5plugin`. Prints Markdown.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from dase import io
from dase.errors import InputError
from perf.benchmarks.kernels import commit

RECORDINGS = ("native/psee_hd_evt3.raw", "native/psee_gen3_evt2.raw", "native/davis346_cuke_cradle.aedat4")
OUT = (("EVT2", "a.raw"), ("EVT3", "b.raw"), ("DAT", "a.dat"), ("text", "a.txt"), ("HDF5", "a.h5"))

OTHER = """
import sys
import numpy as np

def same(want, t, x, y, p, rows=[]):
    got = [np.asarray(a).astype("i8") for a in (t, x, y, np.asarray(p) > 0)]
    if len(got[0]) != len(want[0]):
        return f"{len(got[0])} of {len(want[0])} events"
    if all((a == b).all() for a, b in zip(got, want)):
        return "the same, in order"
    k, l = (np.lexsort(columns[::-1]) for columns in (got, want))
    late = got[0][k] - want[0][l]
    if all((a[k] == b[l]).all() for a, b in zip(got, want)):
        return "the same, in other order"
    if np.abs(late).max() == 1:
        return f"{(late != 0).sum()} times 1 us off"
    return f"other: {(got[0] != want[0]).sum()} times"

def tell(name, act):
    try:
        print(f"{name}: {act()}")
    except BaseException as error:
        print(f"{name}: refused ({' '.join(str(error).split())[:70]})")

def evlib_read(path):
    import evlib
    rows = evlib.load_events(path).collect()
    return rows["t"].dt.total_microseconds().to_numpy(), *(rows[n].to_numpy() for n in ("x", "y", "polarity"))

def wizard_read(path, kind):
    from expelliarmus import Wizard
    rows = Wizard(encoding=kind).read(path)
    return [rows[n] for n in "txyp"]

def wizard_write(path, kind, like):
    from expelliarmus import Wizard
    rows = np.empty(len(want[0]), Wizard(encoding=kind).read(like).dtype)
    for n, column in zip("txyp", want):
        rows[n] = column
    Wizard(encoding=kind).save(path, rows)
    return "written"

def hdf5_read(path):
    import h5py
    with h5py.File(path) as file:
        t, *others = (file[f"events/{n}"][:] for n in ("ts", "xs", "ys", "ps"))
    return np.rint(1e6 * t), *others

def evlib_write(path):
    import evlib
    t, x, y, p = want
    evlib.save_events_to_hdf5(x, y, t / 1e6, p, path)
    return "written"

with np.load("want.npz") as file:
    want = [file[n] for n in "txyp"]
for kind, path in (("evt2", "a.raw"), ("evt3", "b.raw"), ("dat", "a.dat")):
    tell(f"{kind.upper()} to expelliarmus", lambda: same(want, *wizard_read(path, kind)))
    tell("expelliarmus", lambda: wizard_write("out_" + path, kind, path))
for kind, path in (("EVT2", "a.raw"), ("EVT3", "b.raw"), ("text", "a.txt")):
    tell(f"{kind} to evlib", lambda: same(want, *evlib_read(path)))
tell("HDF5 to h5py", lambda: same(want, *hdf5_read("a.h5")))
rows = np.loadtxt("a.txt")
tell("text to NumPy", lambda: same(want, np.rint(1e6 * rows[:, 0]), *rows[:, 1:].T))
tell("evlib", lambda: evlib_write("out.h5"))
tell("EVT3 of expelliarmus to evlib", lambda: same(want, *evlib_read("out_b.raw")))
"""
BACK = (
    ("EVT2 of expelliarmus", "out_a.raw"),
    ("EVT3 of expelliarmus", "out_b.raw"),
    ("DAT of expelliarmus", "out_a.dat"),
    ("HDF5 of evlib", "out.h5"),
)


def back(path: Path, want: list[np.ndarray], size: tuple[int, int]) -> str:
    """Return whether what another library wrote has the same events."""
    try:
        e = io.read(path, size=size).events
    except InputError as error:
        return str(error)
    got = [np.rint(1e6 * e.t).astype(np.int64), *(a.astype(np.int64) for a in (e.x, e.y, e.p))]
    if len(e) != len(want[0]):
        return f"{len(e)} of {len(want[0])} events"
    if all(np.array_equal(a, b) for a, b in zip(got, want, strict=True)):
        return "the same, in order"
    return f"other: {np.count_nonzero(got[0] != want[0])} times"


def main() -> None:
    """Take all recordings through all libraries."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--recordings", type=Path, required=True)
    parser.add_argument(
        "--others", metavar="PYTHON", required=True, help="of an environment with the libraries"
    )
    options = parser.parse_args()
    found: dict[str, list[str]] = {}
    for recording in RECORDINGS:
        with tempfile.TemporaryDirectory() as folder:
            e = io.read(options.recordings / recording).events
            want = [np.rint(1e6 * e.t).astype(np.int64), *(a.astype(np.int64) for a in (e.x, e.y, e.p))]
            np.savez(Path(folder) / "want.npz", **dict(zip("txyp", want, strict=True)))
            for format, name in OUT:
                io.convert(options.recordings / recording, Path(folder) / name, format=format)
            done = subprocess.run(
                [options.others, "-c", OTHER], cwd=folder, capture_output=True, text=True, check=True
            )
            for line in done.stdout.splitlines():
                name, _, told = line.partition(": ")
                if " to " in name:
                    found.setdefault(name, []).append(told)
            for name, file in BACK:
                told = back(Path(folder) / file, want, (e.width, e.height))
                found.setdefault(f"{name} to dase", []).append(told)
    print(f"commit {commit()}\n\n| | {' | '.join(Path(r).stem for r in RECORDINGS)} |\n|{'---|' * 4}")
    for name, told in found.items():
        print(f"| {name} | {' | '.join(told)} |")


if __name__ == "__main__":
    main()
