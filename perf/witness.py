"""What dase computes, as hashes: run before and after a change that must not change results.

    python perf/witness.py -o before.json                   on the checkout before the change
    python perf/witness.py --against before.json            on the checkout after it: "same", or differences
    python perf/witness.py --only synth case/leak           parts of it
    PYTHONPATH=../other python perf/witness.py              another checkout's dase, with this script

It runs the dase that Python finds: that of PYTHONPATH, else that of the checkout of this script. Everything
goes through the command line, as a user would do it, in a temporary folder; only texts of kernels and single
effects, which have no command, are asked of Python. Clip and recordings are made here, with NumPy alone, so
that a difference in one part does not reach the others.

Hashes are the first 16 hexadecimal digits of SHA-256. Of arrays they cover type, shape and content; short
values of JSON and TOML are kept as they are, so that a difference can be read. Left out are

- fields `seconds` (run time), `dase` (version), `date`; see `EXCLUDED`;
- in printed lines: run times, and rates that are derived from them; see `TIMES`;
- reports and figures, which are pictures, and checkpoints, which hold pickled objects;
- paths: there are none, for all files are named relative to the temporary folder.

Where a field is called otherwise after the change, name it in `RENAMED`. Results hold for one kind of CPU or
GPU and one version of NumPy, PyTorch and Warp; what was used is noted under `about`, and a difference there
is said, but is no difference of results. With `--device cuda:0` all parts run that depend on the device. What
is known to differ from run to run is named in `UNSTEADY`.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import io
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
import tomllib
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

ROOT = next(folder for folder in Path(__file__).resolve().parents if (folder / "pyproject.toml").exists())

RENAMED: dict[str, str] = {}
"""Fields and columns that have a new name: new name, or dotted path from the top of the file, to the old
name. Applied to JSON, TOML, and the columns of logs."""

EXCLUDED = {"seconds", "dase", "date"}
"""Fields that differ from run to run or from version to version, wherever they stand."""

UNSTEADY: dict[str, tuple[str, ...]] = {"cpu": (), "cuda": ("train/",)}
"""Prefixes of results that are not the same twice on a kind of device; they are not recorded. On a GPU
PyTorch adds up gradients in an order of its own: of 333 results of trainings 7 to 62 differed between two
runs of one commit."""

TIMES = re.compile(r"\d[\d.,]* (?:Mevents/s|Gsample/s|m?s(?=[:,]|$)|min)", re.MULTILINE)
"""Run times, and rates derived from them, in printed lines."""

LITERAL = 100
"""Characters up to which a value is kept instead of its hash."""

PRESETS = ("davis346", "esim", "v2e-noisy")

TRUTH = "[threshold]\non = 0.22\noff = 0.19\n"
GIVEN = 'name = "given"\n[threshold]\non = 0.25\noff = 0.25\n'
CASES = {
    "nothing": "",
    "bandwidth": "[bandwidth]\ncutoff = 60.0\ndark = 0.05\n",
    "leak": "[leak]\nrate = 3.0\nspread = 0.2\n",
    "shot+refractory": '[shot]\nrate = 6.0\n[refractory]\nperiod = 0.012\nmode = "drop"\n',
}
"""Hidden effects of the cases that are compared, fitted and diagnosed, as tables of the sensor file."""

SENSORS: dict[str, dict[str, dict[str, Any]]] = {
    "light": {
        "optics_blur": {"sigma": 0.8},
        "flicker": {"frequency": 90.0, "depth": 0.2},
        "vignetting": {"loss": 0.5},
        "dark": {"current": 0.01, "spread": 0.3},
    },
    "photoreceptor": {
        "linlog": {"knee": 0.1},
        "second_order": {"cutoff": 150.0},
        "voltage_noise": {"sigma": 0.05},
    },
    "memory": {
        "mismatch": {"spread": 0.2},
        "jitter": {"spread": 0.15},
        "leak": {"rate": 2.0, "light": 3.0},
        "shot": {"rate": 4.0, "balance": 0.3},
        "refractory": {"period": 0.004, "mode": "delay"},
    },
    "array": {
        "bandwidth": {"cutoff": 120.0},
        "hot": {"share": 0.01},
        "dead": {"share": 0.02},
        "latency": {"delay": 0.0005},
        "row_scan": {"line": 2e-6},
        "timestamp": {"jitter": 2e-6, "step": 1e-5},
    },
    "bus": {
        "refractory": {"period": 0.002, "mode": "drop"},
        "hot": {"share": 0.005},
        "readout": {"rate": 200_000.0, "depth": 64.0},
    },
}
"""Sensors that have, together, every effect but learned thresholds: effects and what is not their default."""

NOT_OF_LOG = ("light",)
"""Sensors with effects on light, which are refused where a source gives logarithms."""

KERNEL_PRESETS = ("davis346", "esim", "v2e-noisy", "imx636", "dvxplorer")
KERNEL_TEXTS = {
    "pixel": (("dase.kernels.pixel_compile", "dase.kernels.compose"), "source_text"),
    "trials": (("dase.kernels.pixel_codegen_trials", "dase.kernels.trials"), "source_text"),
}
"""What returns the texts of kernels: modules, new and old, and the name in them."""

EVENT_FORMATS = (".h5", ".npz", ".raw", ".evt2", ".dat", ".aedat2", ".txt", ".csv", ".zip")


def digest(data: bytes | str) -> str:
    """Return the hash of bytes or text."""
    return hashlib.sha256(data.encode() if isinstance(data, str) else data).hexdigest()[:16]


def digest_array(array: np.ndarray) -> str:
    """Return the hash of type, shape and content of an array."""
    array = np.asarray(array)
    if array.dtype.kind == "O":  # texts of HDF5
        return digest(repr(array.tolist()))
    return digest(f"{array.dtype.str} {array.shape} ".encode() + np.ascontiguousarray(array).tobytes())


def fields(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield paths and values of parsed JSON or TOML: short values as they are, long ones as hashes."""
    value = plain(value, path)
    text = json.dumps(value, sort_keys=True)
    if isinstance(value, dict) and (not path or len(text) > LITERAL):
        for name, item in value.items():
            yield from fields(item, f"{path}.{name}" if path else name)
    elif isinstance(value, list) and len(text) > LITERAL and all(isinstance(v, dict) for v in value[:4]):
        for index, item in enumerate(value[:4]):
            yield from fields(item, f"{path}[{index}]")
        yield f"{path}[]", [len(value), digest(text)]
    else:
        yield path, value if len(text) <= LITERAL else digest(text)


def plain(value: Any, path: str = "") -> Any:
    """Return parsed JSON or TOML without excluded fields, and with the old names of renamed ones."""
    if isinstance(value, dict):
        out = {}
        for name, item in value.items():
            where = f"{path}.{name}" if path else name
            old = RENAMED.get(re.sub(r"\[\d*\]", "", where), RENAMED.get(name, name))
            if name not in EXCLUDED and old not in EXCLUDED:
                out[old] = plain(item, where)
        return out
    if isinstance(value, list):
        return [plain(item, path) for item in value]
    return value if isinstance(value, str | int | float | None) else str(value)  # dates of TOML


def tables(text: str) -> dict[str, Any]:
    """Return the fields of TOML text."""
    return dict(fields(tomllib.loads(text)))


def arrays_of(path: Path) -> dict[str, Any]:
    """Return hashes of all arrays and attributes of an HDF5 file, or of all arrays of an archive of NumPy.

    Texts in them that are TOML are taken apart. Arrays of one group of HDF5, such as images, share a hash.
    """
    out: dict[str, Any] = {}
    if zipfile.is_zipfile(path):
        with np.load(path) as data:
            for name in data.files:
                out |= content(name, data[name])
        return out
    import h5py

    groups: dict[str, list[Any]] = {}
    with h5py.File(path) as file:

        def visit(name: str, item: Any) -> None:
            attributes = {k: digest_array(v) for k, v in sorted(item.attrs.items()) if k != "configuration"}
            shared = re.sub(r"\d{3,}$", "*", name)
            groups.setdefault(shared, []).append([name, attributes])
            if "configuration" in item.attrs:
                out.update(content("configuration", np.asarray(item.attrs["configuration"])))
            if isinstance(item, h5py.Dataset):
                groups[shared][-1].append(digest_array(item[()]))

        visit("attributes", file)
        file.visititems(visit)
    return out | {name: digest(json.dumps(found)) for name, found in groups.items()}


def content(name: str, array: np.ndarray) -> dict[str, Any]:
    """Return the hash of an array; of TOML text, its fields."""
    text = array.item() if array.ndim == 0 else None
    if isinstance(text, str):
        return {f"{name}.{field}": value for field, value in tables(text).items()}
    return {name: digest_array(array)}


def under(prefix: str, values: dict[str, Any]) -> dict[str, Any]:
    """Return results with a prefix before their names."""
    return {f"{prefix}/{name}": value for name, value in values.items()}


def clip(width: int = 96, height: int = 64, rate: int = 1000, seconds: float = 0.5) -> dict[str, np.ndarray]:
    """Return frames, uint8, and their times [us]: waves that sway, and discs that move at 20 to 700 px/s."""
    rng = np.random.default_rng(5)
    x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    waves = [(rng.uniform(0.05, 0.9), *rng.uniform(0, 2 * np.pi, 2)) for _ in range(12)]
    discs = [
        (*rng.uniform(0, (width, height)), rng.uniform(4, 11), speed, rng.uniform(0, 6.28), rng.uniform())
        for speed in np.geomspace(20, 700, 7)
    ]
    frames = np.empty((round(rate * seconds) + 1, height, width), np.uint8)
    for k in range(len(frames)):
        t = k / rate
        u, v = x + 6 * np.sin(9 * t), y + 4 * np.cos(7 * t) - 4
        grey = 0.45 + 0.075 * sum(np.sin(f * (u * np.cos(a) + v * np.sin(a)) + b) for f, a, b in waves)
        grey *= np.exp(1.2 * (x / width - 1))
        for column, row, radius, speed, angle, shade in discs:
            along = 18 * np.sin(speed * t / 18)
            away = np.hypot(x - column - along * np.cos(angle), y - row - along * np.sin(angle))
            cover = np.clip(radius - away, 0, 1)
            grey = grey * (1 - cover) + shade * cover
        frames[k] = np.round(np.clip(grey, 0.01, 1) * 255)
    return {"frames": frames, "frame_us": np.arange(len(frames), dtype=np.int64) * (1_000_000 // rate)}


def recording(width: int = 128, height: int = 128, count: int = 20_000) -> dict[str, np.ndarray]:
    """Return a made-up recording as `npz` holds it: noise, a hot pixel, a burst of one row, eight frames."""
    rng = np.random.default_rng(6)
    t = np.sort(rng.integers(1000, 800_000, count)).astype(np.int32)
    x, y = rng.integers(0, width, count), rng.integers(0, height, count)
    x[::17], y[::17] = 40, 30
    burst = slice(count // 2, count // 2 + 200)
    t[burst] = t[burst][0]
    t[burst.stop :] = np.maximum(t[burst.stop :], t[burst][0])
    x[burst], y[burst] = np.arange(200) % width, 12
    begin = np.arange(8, dtype=np.int32) * 100_000
    frames = rng.integers(0, 256, (8, height, width)).astype(np.uint8)
    return {
        "t_us": t, "x": x.astype(np.uint16), "y": y.astype(np.uint16),
        "p": rng.integers(0, 2, count).astype(np.uint8), "wh": np.array([width, height]),
        "frames": frames, "frame_begin_us": begin, "frame_end_us": begin + 5000,
    }  # fmt: skip


def write_foreign(folder: Path) -> list[str]:
    """Write the recording in layouts that dase reads but does not write; return the names of the files."""
    import h5py

    made = recording()
    t, x, y, p = (made[name] for name in ("t_us", "x", "y", "p"))
    with h5py.File(folder / "dsec.h5", "w") as file:
        for name, column in (("t", t.astype(np.uint32)), ("x", x), ("y", y), ("p", p)):
            file[f"events/{name}"] = column
        file["t_offset"] = 5_000_000
    with h5py.File(folder / "mvsec.hdf5", "w") as file:
        file["davis/left/events"] = np.stack([x, y, 1.5e9 + t / 1e6, 2.0 * p - 1], axis=1)
        file["davis/left/image_raw"] = made["frames"]
        file["davis/left/image_raw_ts"] = 1.5e9 + made["frame_begin_us"] / 1e6
    with h5py.File(folder / "v2e.h5", "w") as file:
        file["events"] = np.stack([t, x, y, p], axis=1).astype(np.uint32)
        file["frame"], file["frame_ts"] = made["frames"], made["frame_begin_us"].astype(np.uint32)
    table = np.zeros(len(t), [("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "i1")])
    for name, column in (("t", t), ("x", x), ("y", y), ("p", p)):
        table[name] = column
    np.save(folder / "table.npy", table)
    return ["dsec.h5", "mvsec.hdf5", "v2e.h5", "table.npy"]


@dataclass(frozen=True)
class Bench:
    """Where commands run: a temporary folder, and the device."""

    folder: Path
    device: str

    def environment(self) -> dict[str, str]:
        """Return the environment of commands: this one, with the checkout and a fixed number of threads."""
        path = os.environ.get("PYTHONPATH")
        paths = [str(Path(p).resolve()) for p in path.split(os.pathsep) if p] if path else [str(ROOT)]
        fixed = {"PYTHONPATH": os.pathsep.join(paths), "MPLBACKEND": "Agg"}
        return os.environ | fixed | {"DASE_THREADS": "2", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

    def python(self, *arguments: str, fails: bool = False) -> str:
        """Run Python and return what it prints; raises RuntimeError where it fails, unless it may."""
        command = [sys.executable, *arguments]
        done = subprocess.run(
            command, cwd=self.folder, env=self.environment(), capture_output=True, text=True, check=False
        )
        if done.returncode and not fails:
            raise RuntimeError(f"{' '.join(arguments)}\n{done.stdout}{done.stderr}")
        return done.stdout + (f"exit {done.returncode}\n" if done.returncode else "")

    def dase(self, *arguments: str, fails: bool = False) -> str:
        """Run a dase command on the device and return what it prints."""
        return self.python("-c", MAIN, *arguments, *self.on(arguments[0]), fails=fails)

    def on(self, command: str) -> list[str]:
        """Return the option that names the device: nothing for the CPU, which is the default."""
        if self.device == "cpu" or command not in ("synth", "compare", "fit", "diagnose", "train"):
            return []
        known = self.python("-c", MAIN, command, "--help")
        return ["--device" if "--device" in known else "--backend", self.device]

    def json(self) -> list[str]:
        """Return the option by which `info` prints JSON, which took no file at first."""
        known = self.python("-c", MAIN, "info", "--help")
        return ["--json", "-"] if "--json PATH" in known else ["--json"]

    def worker(self, name: str) -> dict[str, Any]:
        """Return what a worker of this script finds in a process of its own."""
        found: dict[str, Any] = json.loads(self.python(__file__, "--worker", name, "--device", self.device))
        return found


MAIN = "from dase.cli import main; main()"


def printed(text: str) -> dict[str, str]:
    """Return the hash of printed lines, without times."""
    return {"printed": digest(TIMES.sub("TIME", text))}


def synth(bench: Bench, preset: str) -> dict[str, Any]:
    """Random scenes before one sensor, in both formats; the labels with one of them."""
    out: dict[str, Any] = {}
    for kind, more in (("h5", ["--labels"]), ("npz", [])):
        name = f"synth_{preset}_{kind}"
        said = bench.dase(
            "synth", name, "--sensor", preset, "--size", "96x64", "--duration", "0.3", "--sequences", "1",
            "--seed", "3", "--jobs", "1", "--format", kind, *more,
        )  # fmt: skip
        found = arrays_of(next((bench.folder / name).glob(f"*.{kind}")))
        record = tables((bench.folder / name / "synth.toml").read_text())
        out |= under(kind, found | under("synth.toml", record) | printed(said))
    return out


def video(bench: Bench) -> dict[str, Any]:
    """A clip before one sensor."""
    out: dict[str, Any] = {}
    for name in ("video.h5", "video.npz"):
        said = bench.dase("synth", name, "--video", "clip.npz", "--sensor", "davis346", "--labels")
        out |= under(name, arrays_of(bench.folder / name) | printed(said))
    return out


def formats(bench: Bench) -> dict[str, Any]:
    """A made-up recording to every format that is written, and back; what is in each; foreign layouts."""
    np.savez(bench.folder / "made.npz", **recording())
    out: dict[str, Any] = {}
    for suffix in EVENT_FORMATS:
        name = f"made_to{suffix}"
        said = bench.dase("convert", "made.npz", name)
        raw = {"bytes": digest((bench.folder / name).read_bytes())}
        out |= under(f"convert{suffix}", raw | printed(said))
        out |= _read(bench, name, f"read{suffix}")
    for name in write_foreign(bench.folder):
        out |= _read(bench, name, f"read/{name}")
    return out


def _read(bench: Bench, name: str, label: str) -> dict[str, Any]:
    """Return what `info` says of a file, and its content as an archive of NumPy."""
    size = ["--size", "128x128"]  # text does not say it
    told = dict(fields(json.loads(bench.dase("info", name, *bench.json(), *size))))
    back = f"{name}.back.npz"
    bench.dase("convert", name, back, *size)
    lines = printed(bench.dase("info", name, *size))
    return under(label, under("info", told) | under("content", arrays_of(bench.folder / back)) | lines)


def edits(bench: Bench) -> dict[str, Any]:
    """Sensor files that are edited, and what is said of effects."""
    out: dict[str, Any] = {}
    runs = {
        "add": ("add", "davis346", "latency", "--set", "delay=0.0002"),
        "remove": ("remove", "v2e-noisy", "shot"),
        "list": ("effects", "list"),
        "show": ("effects", "show", "refractory"),
        "explain": ("diagnose", "--explain", "leak"),
    }
    for name, arguments in runs.items():
        text = bench.dase(*arguments)
        out |= under(name, tables(text) if name in ("add", "remove") else printed(text))
    (bench.folder / "slow.toml").write_text(GIVEN + CASES["bandwidth"])
    (bench.folder / "fast.toml").write_text(GIVEN)
    little = ["--longest", "2", "--pixels", "300"]
    said = bench.dase("distinguish", "fast.toml", "slow.toml", *little, fails=True)
    return out | under("distinguish", printed(said))


def kernels(bench: Bench) -> dict[str, Any]:
    """Texts of the composed kernels of ten sensors."""
    return bench.worker("kernels")


def simulations(bench: Bench) -> dict[str, Any]:
    """Events and counts of sensors that have, together, all effects."""
    return bench.worker("simulations")


def case(bench: Bench, name: str) -> dict[str, Any]:
    """One hidden set of effects: the recording, and what compare, fit and diagnose make of it."""
    (bench.folder / f"{name}.toml").write_text(f'name = "{name}"\n{TRUTH}{CASES[name]}')
    (bench.folder / f"{name}_given.toml").write_text(GIVEN)
    recorded, given, many = f"{name}.npz", f"{name}_given.toml", ["--pixels", "500"]
    scene = ["--scene", "video", "clip.npz", *many]
    said = bench.dase(
        "synth", recorded, "--video", "clip.npz", "--sensor", f"{name}.toml", "--seed", "7", "--labels"
    )
    out = under("recording", arrays_of(bench.folder / recorded) | printed(said))
    out |= under("compare", _compared(bench, given, recorded, f"{name}_compared.html", *scene))
    if name == "leak":  # the other scenes, once
        for kind in ("frames", "static"):
            how = ["--scene", kind, *many]
            found = _compared(bench, given, recorded, f"{name}_{kind}.html", *how)
            out |= under(f"compare_{kind}", found)
    said = bench.dase("fit", given, recorded, *scene, "-o", f"{name}_fit.toml", fails=True)
    fitted = tables((bench.folder / f"{name}_fit.toml").read_text())
    out |= under("fit", fitted | printed(said))
    files = ["--json", f"{name}_found.json", "-o", f"{name}_found.toml"]
    auto = ["--auto"] if "+" in name else []
    said = bench.dase("diagnose", given, recorded, *scene, *auto, *files)
    found = dict(fields(json.loads((bench.folder / f"{name}_found.json").read_text())))
    sensor = tables((bench.folder / f"{name}_found.toml").read_text())
    return out | under("diagnose", found | under("sensor.toml", sensor) | printed(said))


def _compared(bench: Bench, given: str, recorded: str, page: str, *scene: str) -> dict[str, Any]:
    """Return the numbers of a comparison."""
    said = bench.dase("compare", given, recorded, "-o", page, *scene)
    numbers = json.loads((bench.folder / page).with_suffix(".json").read_text())
    return dict(fields(numbers)) | printed(said)


def train(bench: Bench, name: str) -> dict[str, Any]:
    """Steps of learning: the log, the weights, and what goes with them."""
    import csv

    from safetensors.numpy import load_file

    target, steps = "esim", {"tiny": "40", "wgan": "12", "recorded": "10"}[name]
    more = ["--objective", "wgan"] if name == "wgan" else []
    if name == "recorded":
        target = "learned_from.h5"
        bench.dase("synth", target, "--video", "clip.npz", "--sensor", "esim", "--frame-rate", "100")
    out_folder = f"train_{name}"
    options = ["--preset", "tiny", "--steps", steps, "--sequences", "40", *more]
    said = bench.dase("train", target, "-o", out_folder, *options)
    folder = bench.folder / out_folder
    rows = list(csv.DictReader(io.StringIO((folder / "log.csv").read_text())))
    columns = plain({column: [row[column] for row in rows] for column in rows[0]})
    out = under("log", dict(fields(columns)))
    weights = {key: digest_array(value) for key, value in load_file(folder / "learned.safetensors").items()}
    out |= under("weights", weights) | {"weights": digest(json.dumps(sorted(weights.values())))}
    for file in ("job.json", "recipe.json"):
        out |= under(file, dict(fields(json.loads((folder / file).read_text()))))
    out |= under("sensor.toml", tables((folder / "sensor.toml").read_text()))
    return out | under("examples", arrays_of(folder / "examples.npz")) | printed(said)


PARTS: dict[str, Callable[[Bench], dict[str, Any]]] = {
    "case/shot+refractory": lambda bench: case(bench, "shot+refractory"),
    "case/leak": lambda bench: case(bench, "leak"),
    "train/tiny": lambda bench: train(bench, "tiny"),
    "train/wgan": lambda bench: train(bench, "wgan"),
    "train/recorded": lambda bench: train(bench, "recorded"),
    "case/bandwidth": lambda bench: case(bench, "bandwidth"),
    "case/nothing": lambda bench: case(bench, "nothing"),
    **{f"synth/{preset}": lambda bench, preset=preset: synth(bench, preset) for preset in PRESETS},
    "formats": formats,
    "edits": edits,
    "video": video,
    "simulations": simulations,
    "kernels": kernels,
}  # type: ignore[misc]
"""Name to what runs it; the longest first, for two run at a time."""

ON_CPU_ONLY = ("formats", "edits", "kernels")
"""Parts that have nothing to do with a device."""


def sensor_of(effects: dict[str, dict[str, Any]]) -> Any:
    """Return a sensor with these effects, each with its defaults but for the values given."""
    import dase

    sensor = dase.Sensor()
    for name, values in effects.items():
        sensor = sensor.with_effect(dase.EFFECTS[name](**values))
    return sensor


def kernel_texts(device: str) -> dict[str, Any]:
    """Return hashes of the texts of kernels, as they are and as syntax trees, by sensor and kind.

    Names of modules are replaced, and lines of imports dropped, so that a module that moves changes nothing.
    """
    import dase

    sensors = {name: dase.load_sensor(name) for name in KERNEL_PRESETS}
    sensors |= {name: sensor_of(effects) for name, effects in SENSORS.items()}
    write = {name: located(modules, function) for name, (modules, function) in KERNEL_TEXTS.items()}
    out: dict[str, Any] = {}

    def add(name: str, text: str) -> None:
        lines = [line for line in text.splitlines() if not line.startswith(("import ", "from "))]
        text = re.sub(r"\bdase(\.\w+)+", "dase", "\n".join(lines))
        out[f"{name}/text"] = digest(text)
        out[f"{name}/ast"] = digest(ast.dump(ast.parse(text)))

    for name, sensor in sensors.items():
        stages = sensor.stages()
        for lanes in (0, 1, 16):
            for source in ("frames", "log", "layers", "background"):
                for sink in ("counts", "keys", "labels"):
                    if source == "log" and name in NOT_OF_LOG:
                        continue
                    text = write["pixel"](stages, source, sink, lanes=lanes)
                    add(f"{name}/{source}-{sink}-{lanes}", text)
            if lanes:
                add(f"{name}/trials-{lanes}", write["trials"](stages, lanes=lanes))
    return out


def located(modules: tuple[str, ...], name: str) -> Any:
    """Return what has this name in the first of the modules that is there."""
    for module in modules:
        try:
            return getattr(import_module(module), name)
        except ModuleNotFoundError as error:
            if error.name is None or not module.startswith(error.name):
                raise
    raise SystemExit(f"none of {', '.join(modules)} is there: name the new home of {name} in KERNEL_TEXTS")


def simulated(device: str) -> dict[str, Any]:
    """Return hashes of events, labels, counts and counts of several models, of each sensor of `SENSORS`."""
    import dase

    made = clip(64, 48, 500, 0.3)
    scene = dase.VideoScene(made["frames"].astype(np.float32) / 255, made["frame_us"] * 1e-6)
    edges = np.linspace(0, 0.3, 7)
    out: dict[str, Any] = {}
    for name, effects in ({"ideal": {}} | SENSORS).items():
        sensor = sensor_of(effects)
        events = dase.simulate(scene, sensor, seed=11, device=device, labels=True)
        out |= {f"{name}/{key}": digest_array(getattr(events, key)) for key in ("t", "x", "y", "p", "label")}
        out[f"{name}/events"] = len(events)
        out[f"{name}/counts"] = digest_array(dase.count(scene, sensor, edges, seed=11, device=device))
        batch = np.stack([sensor.parameters(), sensor.parameters()])
        batch[1, :2] *= 1.25
        some = None if "readout" in sensor else np.arange(0, 64 * 48, 7)  # a bus needs all pixels
        counts = dase.count(scene, sensor, edges, seed=11, device=device, pixels=some, parameters=batch)
        out[f"{name}/counts of two models"] = digest_array(counts)
    return out


def processor() -> str:
    """Return the name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.machine()


def about(device: str) -> dict[str, Any]:
    """Return what was run on what."""
    import warp

    import dase

    where = Path(str(dase.__file__)).resolve().parent

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(where), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout

    commit, state = git("rev-parse", "--verify", "-q", "HEAD") or "unknown", git("status", "--porcelain")
    changed = any(line[3:].startswith(("dase", "kernels", "cli")) for line in state.splitlines())
    out = {"commit": commit.strip() + " with changes" * changed, "device": device}
    out |= {"machine": processor(), "python": platform.python_version(), "numpy": np.__version__}
    out |= {"warp": warp.config.version}
    try:
        import torch

        out["torch"] = torch.__version__
        if device.startswith("cuda"):
            out["gpu"] = torch.cuda.get_device_name(device)
    except ModuleNotFoundError:
        pass
    return out


WORKERS: dict[str, Callable[[str], dict[str, Any]]] = {
    "kernels": kernel_texts, "simulations": simulated, "about": about,
}  # fmt: skip


def run(names: list[str], bench: Bench) -> tuple[dict[str, Any], list[str]]:
    """Run parts, two at a time; return their results by name, and the parts that failed."""
    np.savez(bench.folder / "clip.npz", **clip())
    found: dict[str, dict[str, Any]] = {}
    failed: list[str] = []
    begin = time.perf_counter()

    def timed(name: str) -> float:
        started = time.perf_counter()
        found[name] = PARTS[name](bench)
        return time.perf_counter() - started

    with ThreadPoolExecutor(2) as pool:
        works = {pool.submit(timed, name): name for name in names}
        for number, work in enumerate(as_completed(works), 1):
            name = works[work]
            try:
                said = f"{work.result():.0f} s, {len(found[name])} results"
            except Exception as error:
                failed.append(name)
                said = f"failed: {error}"
            now = time.perf_counter() - begin
            print(f"[{number}/{len(names)}, {now:.0f} s] {name}: {said}", file=sys.stderr, flush=True)
    kind = "cpu" if bench.device == "cpu" else "cuda"
    results = {f"{name}/{k}": v for name in sorted(found) for k, v in sorted(found[name].items())}
    return {k: v for k, v in results.items() if not k.startswith(UNSTEADY[kind] or ("\0",))}, failed


def differences(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """Return a line for each result that differs, is missing, or is new."""
    out = []
    for name in sorted({*before, *after}):
        if name not in after:
            out.append(f"missing    {name}")
        elif name not in before:
            out.append(f"new        {name} = {after[name]}")
        elif json.dumps(before[name]) != json.dumps(after[name]):
            out.append(f"different  {name}: {before[name]} → {after[name]}")
    return out


def chosen(only: list[str] | None, device: str) -> list[str]:
    """Return the parts to run; raises SystemExit for a name that is none."""
    possible = [name for name in PARTS if device == "cpu" or name not in ON_CPU_ONLY]
    for asked in only or ():
        if not any(belongs(name, asked) for name in possible):
            raise SystemExit(f"there is no part '{asked}' on {device}: {', '.join(possible)}")
    return [name for name in possible if not only or any(belongs(name, asked) for asked in only)]


def belongs(name: str, part: str) -> bool:
    """Return whether a part, or a result, is `part` or in it."""
    return name == part or name.startswith(f"{part}/")


def main() -> int:
    """Run, write, compare; the exit code is 1 where anything differs or failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, help="JSON file to write; without, it is printed")
    parser.add_argument("--against", type=Path, help="JSON file of another run to compare with")
    parser.add_argument("--device", default="cpu", help="cpu or cuda:0")
    parser.add_argument("--only", nargs="+", metavar="NAME", help=f"of {', '.join(PARTS)}")
    parser.add_argument("--worker", choices=WORKERS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        print(json.dumps(WORKERS[options.worker](options.device)))
        return 0
    names = chosen(options.only, options.device)
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder), options.device)
        facts = bench.worker("about")
        print(f"dase {facts['commit']} on {options.device}", file=sys.stderr, flush=True)
        results, failed = run(names, bench)
    text = json.dumps({"about": facts, "results": results}, indent=1) + "\n"
    if options.output:
        options.output.write_text(text)
    if not options.against:
        if not options.output:
            print(text, end="")
        return 1 if failed else 0
    other = json.loads(options.against.read_text())
    for name, value in other["about"].items():
        if name != "commit" and facts.get(name) != value:
            print(f"note: {name} was {value}, is {facts.get(name)}")
    done = [name for name in names if name not in failed]
    wanted = {k: v for k, v in other["results"].items() if any(belongs(k, name) for name in done)}
    lines = differences(wanted, results)
    lines += [f"failed     {name}" for name in failed]
    print("\n".join(lines) or f"same: {len(results)} results")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
