"""Small files of every format, built apart from the readers under test, and ways to damage them."""

from __future__ import annotations

import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.ecf_files import ecf_buffer

from dase import io
from dase.events import Events
from dase.io.sequence import Sequence

W, H = 240, 180
FRAMES = 3
PEAK = """
def peak():
    # not ru_maxrss, which begins with what the parent had
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("VmHWM")) / 1024

def apart(act):
    import os, sys
    for argument in sys.argv[1:]:
        sys.stdout.flush()
        child = os.fork()
        if not child:
            act(argument)
            sys.exit()
        if os.waitpid(child, 0)[1]:
            sys.exit("it failed")
"""
"""Script that defines `peak`: the largest memory that the process has had [MiB]; and `apart`, which acts on
each argument in a process of its own, whose peak begins with what the script has imported once for all."""


def measured(script: str, *arguments: object) -> list[str]:
    """Run a script that may call `peak` in a process of its own; return the lines it prints."""
    if not Path("/proc/self/status").exists():
        pytest.skip("the memory of a process is told by /proc")
    command = [sys.executable, "-c", PEAK + script, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()


def events(rng, count=3000, width=W, height=H, begin_us=0, step_us=40):
    """Events with times in whole microseconds, several at a time."""
    t = begin_us + np.cumsum(rng.integers(0, step_us, count) * (rng.random(count) < 0.7))
    x, y = (rng.integers(0, n, count, np.uint16) for n in (width, height))
    if count:
        x[-1], y[-1] = width - 1, height - 1  # the size can be found from the events
    return Events(t / 1e6, x, y, rng.random(count) < 0.5, width, height)


def microseconds(events):
    return np.rint(events.t * 1e6).astype(np.int64)


def written(format):
    return lambda path, e: io.write(path, Sequence(e), format=format)


def evt21(path, e, *, legacy=False, said=True):
    """Each event in a word of its own, at bit x % 32; rows of the same time and polarity are not joined."""
    t = microseconds(e)
    words = []
    last = None
    for k in range(len(t)):
        if t[k] >> 6 != last:
            last = int(t[k] >> 6)
            words.append((8 << 60) | ((last & 0xFFFFFFF) << 32))
        base, bit = int(e.x[k]) // 32 * 32, int(e.x[k]) % 32
        place = int(e.p[k]) << 60 | (int(t[k]) & 63) << 54 | base << 43 | int(e.y[k]) << 32
        words.append(place | 1 << bit)
    data = np.array(words, "<u8")
    if legacy:
        data = data.view("<u4").reshape(-1, 2)[:, ::-1].copy()
    option = f";endianness={'legacy' if legacy else 'little'}" if said else ""
    head = f"% evt 2.1\n% format EVT21;height={e.height};width={e.width}{option}\n% end\n"
    path.write_bytes(head.encode() + data.tobytes())


def flatbuffer(fields, identifier=b"EVTS"):
    """A table: index to (struct format, number) or to bytes of a vector with their number of elements."""
    count = max(fields) + 1
    table_at = (8 + 4 + 2 * count + 7) // 8 * 8  # numbers are aligned with the size before the buffer
    place, places, body, vectors = 4, [0] * count, b"", []
    for index in sorted(fields, key=lambda i: not isinstance(fields[i], tuple)):
        value = fields[index]
        size = struct.calcsize(value[0]) if isinstance(value[0], str) else 4
        pad = -(table_at + place + 4) % size
        body, place = body + b"\0" * pad, place + pad
        places[index] = place
        if not isinstance(value[0], str):
            vectors.append((len(body), value))
            body += b"\0\0\0\0"
        else:
            body += struct.pack("<" + value[0], value[1])
        place += size
    body = bytearray(body)
    tail = b""
    for at, (data, elements) in vectors:
        start = table_at + 4 + len(body) + len(tail)
        pad = -(start + 8) % 8
        tail += b"\0" * pad
        struct.pack_into("<I", body, at, start + pad - (table_at + 4 + at))
        tail += struct.pack("<I", elements) + data
    fields_at = table_at - 4 - 2 * count
    out = (struct.pack("<I", table_at) + identifier).ljust(fields_at, b"\0")
    out += struct.pack(f"<HH{count}H", 4 + 2 * count, place, *places)
    return out + struct.pack("<i", table_at - fields_at) + bytes(body) + tail


AEDAT4_XML = """<dv version="2.0"><node name="outInfo" path="/mainloop/Recorder/outInfo/">{}</node></dv>"""
AEDAT4_STREAM = """<node name="{}" path="/"><attr key="typeIdentifier" type="string">{}</attr>
<node name="info" path="/"><attr key="sizeX" type="int">{}</attr>
<attr key="sizeY" type="int">{}</attr></node></node>"""
UNIX_US = 1_643_243_628_737_093


def aedat4(
    path,
    e,
    *,
    frames=None,
    motion=None,
    compression=0,
    compress=lambda data: data,
    packet=500,
    origin=UNIX_US,
):
    """Events, frames as (begin_us, end_us, grey), and samples (t_us, acceleration, rotation) in packets."""
    streams = [AEDAT4_STREAM.format(0, "EVTS", e.width, e.height)]
    streams += [AEDAT4_STREAM.format(1, "FRME", e.width, e.height)] if frames else []
    streams += [AEDAT4_STREAM.format(2, "IMUS", 0, 0)] if motion else []
    xml = AEDAT4_XML.format("".join(streams)).encode()
    head = flatbuffer({0: ("i", compression), 1: ("q", -1), 2: (xml, len(xml))}, b"IOHE")
    out = [b"#!AER-DAT4.0\r\n", struct.pack("<I", len(head)), head]

    def put(stream, fields):
        data = fields if isinstance(fields, bytes) else flatbuffer(fields, (b"EVTS", b"FRME")[stream])
        data = compress(struct.pack("<I", len(data)) + data)
        out.append(struct.pack("<ii", stream, len(data)) + data)

    kind = np.dtype([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "u1"), ("pad", "V3")])
    for i in range(0, len(e), packet):
        k = slice(i, i + packet)
        rows = np.zeros(len(e.t[k]), kind)
        rows["t"], rows["x"], rows["y"], rows["p"] = microseconds(e)[k] + origin, e.x[k], e.y[k], e.p[k]
        put(0, {0: (rows.tobytes(), len(rows))})
    for begin, end, grey in frames or ():
        numbers = {k: ("q", v + origin) for k, v in ((0, begin), (1, begin), (2, end), (3, begin), (4, end))}
        height, width = grey.shape
        put(1, numbers | {5: ("b", 0), 6: ("h", width), 7: ("h", height), 10: (grey.tobytes(), grey.size)})
    for t, acceleration, rotation in motion or ():
        put(2, motion_packet(t + origin, (*acceleration, *rotation)))
    path.write_bytes(b"".join(out))


def motion_packet(t, values):
    """A packet of two equal samples: a root table with a vector of tables, built by hand."""
    fields = struct.pack("<9H", 22, 40, 8, 0, *range(16, 40, 4)[:5]) + struct.pack("<2H", 36, 0)
    sample = struct.pack("<iiq6f", 0, 0, t, *values)
    head = struct.pack("<I", 16) + b"IMUS" + struct.pack("<3H", 6, 8, 4) + b"\0\0"  # root at 16, fields at 8
    root = struct.pack("<ii", 8, 4)  # its vector begins 4 bytes behind the field
    vector_at = 16 + 8
    table_at = vector_at + 12
    fields_at = table_at + 2 * len(sample)
    vector = struct.pack("<III", 2, *(table_at + k * len(sample) - vector_at - 4 - 4 * k for k in (0, 1)))
    tables = b"".join(struct.pack("<i", table_at + k * len(sample) - fields_at) + sample[4:] for k in (0, 1))
    return head + root + vector + tables + fields


def dsec(path, e, *, offset=49_599_300_523, **packing):
    with h5py.File(path, "w") as file:
        kinds, values = ("u4", "u2", "u2", "u1"), (microseconds(e), e.x, e.y, e.p)
        for name, kind, column in zip("txyp", kinds, values, strict=True):
            file.create_dataset(f"events/{name}", data=column.astype(kind), **packing)
        milliseconds = np.arange(int(e.t[-1] * 1e3) + 1)
        file["ms_to_idx"] = np.searchsorted(e.t, milliseconds / 1e3)
        file["t_offset"] = offset


def mvsec(path, e, *, frames=None, origin=1_504_645_177.42):
    with h5py.File(path, "w") as file:
        rows = np.stack([e.x, e.y, e.t + origin, np.where(e.p, 1.0, -1.0)], axis=1)
        file["davis/left/events"] = rows
        if frames is not None:
            times, grey = frames
            file["davis/left/image_raw"], file["davis/left/image_raw_ts"] = grey, times + origin


def v2e(path, e, *, frames=None):
    with h5py.File(path, "w") as file:
        rows = np.stack([microseconds(e), e.x, e.y, e.p], axis=1).astype(np.uint32)
        file.create_dataset("events", data=rows, maxshape=(None, 4), compression="gzip")
        if frames is not None:
            times, grey = frames
            file["frame"], file["frame_ts"] = grey, np.rint(times * 1e6).astype(np.uint32)


def ecf(path, e, *, mode=2, chunk=1024):
    kind = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
    with h5py.File(path, "w") as file:
        file.attrs["geometry"] = f"{e.width}x{e.height}"
        properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        properties.set_chunk((chunk,))
        properties.set_filter(0x8ECF, h5py.h5z.FLAG_OPTIONAL)
        space = h5py.h5s.create_simple((len(e),), (h5py.h5s.UNLIMITED,))
        group = file.create_group("CD")
        events = h5py.h5d.create(group.id, b"events", h5py.h5t.py_create(kind), space, properties)
        t = microseconds(e)
        for i in range(0, len(e), chunk):
            k = slice(i, i + chunk)
            events.write_direct_chunk((i,), ecf_buffer(t[k], e.x[k], e.y[k], e.p[k].astype(np.uint8), mode))


def table(path, e):
    rows = np.zeros(len(e), [("x", "<u2"), ("y", "<u2"), ("p", "?"), ("t", "<i8")])
    rows["t"], rows["x"], rows["y"], rows["p"] = microseconds(e), e.x, e.y, e.p
    np.save(path, rows) if path.suffix == ".npy" else np.savez_compressed(path, events=rows)


def plain(path, e, *, order="xytp"):
    """A table of numbers whose columns have no names."""
    columns = {"t": microseconds(e), "x": e.x, "y": e.y, "p": e.p}
    np.save(path, np.stack([columns[letter] for letter in order], axis=1).astype(np.int64))


def event_stream(path, e, *, kind=1, exposures=()):
    """DVS or ATIS events byte by byte; `exposures` are indices of ATIS events that are not of change."""
    out = b"Event Stream" + bytes((2, 0, 0, kind)) + struct.pack("<HH", e.width, e.height)
    now, most = 0, 127 if kind == 1 else 63
    for k, t in enumerate(microseconds(e).tolist()):
        step, now = t - now, t
        if kind == 1:
            out += b"\xff" * (step // most)
            step %= most
            first = step << 1 | int(e.p[k])
        else:
            while step >= most:
                times = min(step // most, 3)
                out += bytes([0xFC | times])
                step -= most * times
            first = step << 2 | int(e.p[k]) << 1 | (k in exposures)
        out += bytes([first]) + struct.pack("<HH", e.x[k], e.y[k])
    path.write_bytes(out)


def nmnist(path, e):
    """Five bytes per event; the time starts over where it reaches 2^13 us, marked by a row of 240."""
    out, turns = b"", 0
    for t, x, y, p in zip(microseconds(e).tolist(), e.x.tolist(), e.y.tolist(), e.p.tolist(), strict=True):
        while t - turns * 8192 >= 8192:
            turns += 1
            out += bytes([0, 240, 0, 0, 0])
        word = int(p) << 23 | t - turns * 8192
        out += bytes([x, y]) + word.to_bytes(3, "big")
    path.write_bytes(out)


def matlab(path, e, *, compress=True, structure=True, shift=0):
    """What `savemat` writes: a structure with the fields ts, x, y and p, columns counted from `shift`."""
    from scipy.io import savemat

    columns = {"x": e.x.astype(np.float64) + shift, "y": e.y.astype(np.float64) + shift}
    columns |= {"ts": microseconds(e).astype(np.float64), "p": e.p.astype(np.float64) + shift}
    savemat(path, {"about": "a text", "TD": columns} if structure else columns, do_compression=compress)


def matlab73(path, e):
    """A MATLAB file of version 7.3: HDF5 behind 512 bytes, a group with rows of float64."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, column in {"x": e.x, "y": e.y, "ts": microseconds(e), "pol": e.p}.items():
            file[f"TD/{name}"] = column.astype(np.float64)[None]
    data = bytearray(path.read_bytes())
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + struct.pack("<H2s", 0x0200, b"IM")
    data[: len(head)] = head
    path.write_bytes(data)


AEDAT3_HEAD = b"#!AER-DAT3.1\r\n#Format: RAW\r\n#Source 1: {}\r\n#Start-Time: 2017\r\n#!END-HEADER\r\n"


def aedat3(path, e, *, frames=(), motion=(), packet=500, chip=b"DAVIS240C", overflows=0):
    """Polarity packets, frames as (begin_us, end_us, grey), samples (t_us, acceleration, rotation)."""
    out = [AEDAT3_HEAD.replace(b"{}", chip)]

    def put(kind, place, events):
        size = len(events[0])
        out.append(
            struct.pack("<hh6i", kind, 1, size, place, overflows, len(events), len(events), len(events))
        )
        out.extend(events)

    t = microseconds(e)
    for i in range(0, len(e), packet):
        k = slice(i, i + packet)
        word = (
            1 | e.p[k].astype(np.uint32) << 1 | e.y[k].astype(np.uint32) << 2 | e.x[k].astype(np.uint32) << 17
        )
        put(1, 4, [struct.pack("<Ii", *row) for row in zip(word.tolist(), t[k].tolist(), strict=True)])
    for begin, end, grey in frames:
        height, width = grey.shape
        numbers = (1 | 1 << 1, begin - 9, end + 9, begin, end, width, height, 0, 0)
        put(2, 8, [struct.pack("<I8i", *numbers) + grey.astype("<u2").tobytes()])
    for time, acceleration, rotation in motion:
        put(3, 4, [struct.pack("<Ii7f", 1, time, *acceleration, *rotation, 20.0)])
    path.write_bytes(b"".join(out))


DVS = {
    "dvs_msgs/msg/Event": "uint16 x\nuint16 y\ntime ts\nbool polarity\n",
    "dvs_msgs/msg/EventArray": "std_msgs/Header header\nuint32 height\nuint32 width\n"
    "dvs_msgs/Event[] events\n",
    "event_camera_msgs/msg/EventPacket": "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\n"
    "uint64 time_base\nstring encoding\nbool is_bigendian\nuint8[] events\n",
}


class Messages:
    """Makes and packs messages of ROS 1 or 2 with rosbags."""

    def __init__(self, ros):
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.store = store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
        for name, text in DVS.items():
            text = text if ros == 1 else text.replace("time ts", "builtin_interfaces/Time ts")
            store.register(get_types_from_msg(text, name))
        self.pack = store.serialize_ros1 if ros == 1 else store.serialize_cdr
        self.number = {"seq": 7} if ros == 1 else {}

    def make(self, name, **fields):
        return self.store.types[name](**fields)

    def stamp(self, t):
        sec, us = divmod(int(t), 10**6)
        return self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=us * 1000)

    def put(self, writer, topic, name, t, **fields):
        header = self.make("std_msgs/msg/Header", **self.number, stamp=self.stamp(t), frame_id="camera")
        message = self.make(name, header=header, **fields)
        writer.write(topic, int(t) * 1000, self.pack(message, name))

    def events(self, x, y, t, p):
        rows = zip(x.tolist(), y.tolist(), t.tolist(), p.tolist(), strict=True)
        name = "dvs_msgs/msg/Event"
        return [self.make(name, x=a, y=b, ts=self.stamp(c), polarity=d) for a, b, c, d in rows]


def bag(
    path, e, *, ros=1, packet=500, kind="array", frames=None, origin=1_500_000_000_000_000, mode="", **options
):
    """A bag of ROS 1 or 2; `kind` is "array", or an encoding with its encoder; `mode` is what ROS 2 packs."""
    from rosbags import rosbag1, rosbag2

    messages = Messages(ros)
    writer = rosbag1.Writer(path) if ros == 1 else rosbag2.Writer(path, version=9, **options)
    if ros == 1 and "compression" in options:
        writer.set_compression(rosbag1.Writer.CompressionFormat[options["compression"]])
    if mode:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode

        writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    name = "dvs_msgs/msg/EventArray" if kind == "array" else "event_camera_msgs/msg/EventPacket"
    size = {"height": e.height, "width": e.width}
    t = microseconds(e) + origin
    with writer:
        topic = writer.add_connection("/dvs/events", name, typestore=messages.store)
        for i in range(0, len(e), packet):
            k = slice(i, i + packet)
            if kind == "array":
                fields = {"events": messages.events(e.x[k], e.y[k], t[k], e.p[k])}
            else:
                data, base = kind[1](e, k)
                fields = {"seq": i, "time_base": base, "encoding": kind[0], "is_bigendian": False}
                fields["events"] = np.frombuffer(data, np.uint8)
            messages.put(writer, topic, name, t[i], **size, **fields)
        if frames is None:
            return
        name = "sensor_msgs/msg/Image"
        topic = writer.add_connection("/dvs/image_raw", name, typestore=messages.store)
        for time, grey in zip(np.rint(frames[0] * 1e6) + origin, frames[1], strict=True):
            fields = {"encoding": "mono8", "is_bigendian": 0, "step": grey.shape[1]}
            messages.put(writer, topic, name, time, **size, **fields, data=grey.reshape(-1))


def mcap(path, e):
    """One file of a ROS 2 bag, with packed chunks."""
    from rosbags.rosbag2 import StoragePlugin

    folder = path.with_name(f"{path.stem}_folder")
    bag(folder, e, ros=2, mode="STORAGE", storage_plugin=StoragePlugin.MCAP)
    (single,) = folder.glob("*.mcap")
    single.replace(path)
    (folder / "metadata.yaml").unlink()
    folder.rmdir()


SAMPLES: dict[str, tuple[str, Callable[[Path, Events], None]]] = {
    "EVT2": (".raw", written("EVT2")),
    "EVT3": (".raw", written("EVT3")),
    "EVT2.1": (".raw", evt21),
    "EVT2.1 legacy": (".raw", lambda path, e: evt21(path, e, legacy=True, said=False)),
    "DAT": (".dat", written("DAT")),
    "AEDAT2": (".aedat", written("AEDAT2")),
    "AEDAT4": (".aedat4", aedat4),
    "text": (".txt", written("text")),
    "zip of text": (".zip", written("zip of text")),
    "HDF5": (".h5", written("HDF5")),
    "NumPy archive": (".npz", written("NumPy archive")),
    "DSEC": (".h5", dsec),
    "MVSEC": (".hdf5", mvsec),
    "v2e": (".h5", v2e),
    "ECF": (".hdf5", ecf),
    "array": (".npy", table),
    "array in an archive": (".npz", table),
    "ROS 1": (".bag", bag),
    "ROS 2": (".folder", lambda path, e: bag(path, e, ros=2)),
    "MCAP": (".mcap", mcap),
    "NumPy table": (".npy", plain),
    "Event Stream": (".es", event_stream),
    "Event Stream ATIS": (".es", lambda path, e: event_stream(path, e, kind=2)),
    "N-MNIST": (".bin", nmnist),
    "MATLAB": (".mat", matlab),
    "MATLAB 7.3": (".mat", matlab73),
    "AEDAT3": (".aedat", aedat3),
}
"""Name to suffix and a function that writes events to a path."""


def mutated(data: bytes, rng) -> bytes:
    """Damage a file: flip bytes, cut, repeat, insert, or overwrite a number; mostly near its begin."""
    out = bytearray(data)
    reach = len(out) if rng.random() < 0.5 else min(len(out), 400)
    for _ in range(rng.integers(1, 8)):
        kind, at = rng.integers(0, 6), int(rng.integers(0, max(reach, 1)))
        if not out:
            break
        at = min(at, len(out) - 1)
        if kind == 0:
            out[at] ^= 1 << int(rng.integers(0, 8))
        elif kind == 1:
            out[at] = int(rng.integers(0, 256))
        elif kind == 2 and rng.random() < 0.3:
            del out[at + int(rng.integers(0, len(out))) :]
        elif kind == 3:
            out[at : at + 4] = struct.pack("<I", int(rng.choice([0, 1, 0x7FFFFFFF, 0xFFFFFFFF, 0x80000000])))
        elif kind == 4:
            end = at + int(rng.integers(0, 64))
            out[at:at] = out[at:end]
        else:
            del out[at : at + int(rng.integers(0, 9))]
    return bytes(out)


NEEDS = {"ROS 1": "rosbags", "ROS 2": "rosbags", "MCAP": "rosbags"}


def sample(tmp_path, name, e):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    suffix, make = SAMPLES[name]
    path = tmp_path / f"sample{suffix}"
    make(path, e)
    return path
