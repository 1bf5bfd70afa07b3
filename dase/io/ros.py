"""ROS bags: ROS 1 (.bag) and ROS 2 (folder with metadata.yaml, or a single .mcap or .db3).

Read are the first topic of dvs_msgs/EventArray (or prophesee_event_msgs, of the same layout) or of
event_camera_msgs/EventPacket (before 2023: event_array_msgs/EventArray), and the first topic of images beside
it. Others are noted. Times count from the first event. The times of images are their stamps: a bag does not
say how long they were exposed. Bags are opened by `rosbags` (Apache-2.0), the extra "ros"; their messages are
parsed in `dase.io.ros_messages`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from dase.errors import InputError
from dase.io import packed, ros_messages
from dase.io.format import camera_format
from dase.io.source import Picture, Piece, Size, Source, missing_extra

ARRAYS = ("dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray")
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
ROS1 = b"#ROSBAG V"


@contextmanager
def _open_bag(source: Source) -> Iterator[tuple[Any, bool]]:
    """Open a bag; yield rosbags' reader and whether its messages are CDR."""
    try:
        from rosbags import rosbag1, rosbag2
    except ImportError:
        raise missing_extra("a ROS bag", "ros") from None
    cdr = source.path.is_dir() or not _starts_with(source.path, ROS1)
    with packed.bounded_bags(), ExitStack() as stack:
        try:
            reader = stack.enter_context(rosbag2.Reader(source.path) if cdr else rosbag1.Reader(source.path))
        except rosbag2.ReaderError as error:
            # metadata written by hand, by converters or by recorders that were killed lack entries; those of
            # the files themselves are all that is needed
            files = sorted(file for file in source.path.glob("*") if file.suffix in (".mcap", ".db3"))
            if not files or "missing: [" in str(error):
                raise
            source.note(
                f"metadata.yaml is of no use ({error}): its {len(files)} files were read one after the other",
                "repaired",
                "metadata",
            )
            reader = _Chain([stack.enter_context(rosbag2.Reader(file)) for file in files])
        yield reader, cdr


class _Chain:
    """Several files of one bag, read one after the other."""

    def __init__(self, readers: list[Any]) -> None:
        self._readers = readers
        self.connections = [connection for reader in readers for connection in reader.connections]

    def messages(self, connections: list[Any]) -> Iterator[tuple[Any, int, bytes]]:
        for reader in self._readers:
            own = [one for one in reader.connections if any(one is asked for asked in connections)]
            if own:  # rosbags takes none for all
                yield from reader.messages(own)


def _starts_with(path: Path, magic: bytes) -> bool:
    with path.open("rb") as file:
        return file.read(len(magic)) == magic


def _find_connections(source: Source, reader: Any, kinds: tuple[str, ...], beside: str = "") -> list[Any]:
    """Return the connections of the first topic of these types; of several the nearest to `beside`."""
    found: dict[str, list[Any]] = {}
    for connection in reader.connections:
        if connection.msgtype in kinds and connection.msgcount:
            found.setdefault(connection.topic, []).append(connection)
    if not found:
        return []

    def apart(topic: str) -> tuple[int, str]:
        pairs = zip(topic.split("/"), beside.split("/"), strict=False)
        return -sum(a == b for a, b in pairs), topic

    topic = min(found, key=apart)
    if len(found) > 1:
        source.note(
            f"holds topics {', '.join(sorted(found))}: {topic} was read", "assumed", "streams", len(found)
        )
    return found[topic]


def _event_connections(source: Source, reader: Any) -> list[Any]:
    # packed by the drivers of event_camera_msgs, under their name and under that of before
    packets = ("event_camera_msgs/msg/EventPacket", "event_array_msgs/msg/EventArray")
    found = _find_connections(source, reader, ARRAYS + packets)
    if not found:
        known = sorted(f"{c.topic} ({c.msgtype})" for c in reader.connections)
        raise InputError(f"has no topic of events, only {', '.join(known[:8]) or 'none'}")
    return found


def read_pieces(source: Source) -> Iterator[Piece]:
    """Yield the events [ns]."""
    with _open_bag(source) as (reader, cdr):
        packets = ros_messages.Packets()
        for connection, _, data in _read_messages(source, reader, _event_connections(source, reader)):
            if connection.msgtype in ARRAYS:
                yield ros_messages.event_array(data, cdr)
            else:
                yield from packets(data, cdr)
        packets.evt3.report(source)
        packets.evt2.report(source)


def _read_messages(source: Source, reader: Any, connections: list[Any]) -> Iterator[tuple[Any, int, bytes]]:
    """Yield messages; a damaged part ends the bag, which is noted."""
    messages = reader.messages(connections)
    while True:
        try:
            message = next(messages)
        except StopIteration:
            return
        except Exception as error:  # rosbags lets pass what its decompressors and its parsers raise
            why = " ".join(str(error).split()) or type(error).__name__
            source.note(f"damaged or cut short, read up to there ({why})", "refused", "damage", 1)
            return
        yield message


def read_size(source: Source) -> Size | None:
    """Return columns and rows as the first message of events tells them."""
    with _open_bag(source) as (reader, cdr):
        for _, _, data in _read_messages(source, reader, _event_connections(source, reader)):
            found = ros_messages.dvs_size(data, cdr)
            return found if all(found) else None
    return None


def read_pictures(source: Source) -> Iterator[Picture]:
    """Yield the images [ns]."""
    with _open_bag(source) as (reader, cdr):
        connections = _find_connections(source, reader, IMAGES, _event_connections(source, reader)[0].topic)
        if not connections:
            return  # rosbags takes none for all
        for connection, _, data in _read_messages(source, reader, connections):
            time, grey = ros_messages.decode_image(data, cdr, connection.msgtype == IMAGES[1])
            yield Picture(grey, time)


def matches_format(path: Path, head: bytes) -> bool:
    """Whether a file is a bag, or a folder the bag of ROS 2."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return head.startswith((ROS1, b"\x89MCAP0\r\n", b"SQLite format 3\0"))


FORMAT = camera_format(
    name="ROS bag",
    suffixes=(".bag", ".mcap", ".db3"),
    extra="ros",
    matches=matches_format,
    pieces=read_pieces,
    size=read_size,
    pictures=read_pictures,
    ticks=1e9,
)
