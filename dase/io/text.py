"""Events as text, a line each: time, column, row, polarity.

    # 346 260 columns and rows                lines that begin with # are skipped; ours tells the size
    346 260                                   rpg_e2vid: a first line of two numbers tells the size
    0.003811000 96 133 0                      t x y p: seconds, or microseconds where no time has a point
    96,133,0,3811                             x,y,p,t: as metavision_file_to_csv writes it, microseconds
    timestamp,x,y,polarity                    names of the columns, in any order

Other orders of the columns are told by the user or from the values, and said, see `dase.io.column_order`.
Polarity is 0 or 1, or -1 or 1. Times are read exactly as Python's `float` would. Sources: the IJRR data
(Mueggler et al., The event-camera dataset and simulator, 2017), rpg_e2vid, v2e.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.io.column_order import checked_order, named_order, note_order, recognised_order
from dase.io.source import Piece, Size, Source


@dataclass(frozen=True)
class TextLimits:
    """How much of a text is looked at together."""

    block: int = 1 << 20
    """Bytes decoded at once."""

    line: int = 200
    """Bytes of the longest line."""

    head: int = 1 << 14
    """Bytes that are looked at to tell the columns."""

    digits: int = 17
    """Of a time, point included, that fit the fast path."""


LIMITS = TextLimits()

# every text has one way to match: two, as of digits before and after a missing point, take quadratic time
NUMBER = rb"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
LINE = re.compile(rb"[ \t]*" + rb"[ \t,]+".join([b"(" + NUMBER + b")"] * 4) + rb"(?:[ \t,]+\d+)?[ \t,]*\r?")
SIZE = re.compile(rb"(?:# *)?(\d{1,6})[ \t,]+(\d{1,6})(?: columns and rows.*)?\r?")


class Layout:
    """What the first lines tell: bytes before the events, size, order of the columns, unit of the time.

    Raises:
        InputError: The first lines do not hold events.
    """

    def __init__(self, head: bytes, source: Source | None = None) -> None:
        named: str | None = None
        self.size: Size | None = None
        self.begin = 0
        lines = head.split(b"\n")
        if len(lines) > 1:
            lines.pop()  # it may be cut
        rows: list[list[bytes]] = []
        for line in lines:
            if match := None if rows or self.size else SIZE.fullmatch(line):
                self.size = int(match[1]), int(match[2])
            elif match := LINE.fullmatch(line):
                rows.append(list(match.groups()))
            elif rows and line.strip():
                break  # left to the decoder, which knows the number of the line
            elif not rows and _names_columns(line):
                named = named_order(re.split(r"[ ,\t]+", line.decode("latin-1").strip())) or named
            elif not rows and not line.startswith(b"#") and line.strip():
                raise InputError(f"holds no events: '{line[:40].decode('latin-1')}' is not 't x y p'")
            if not rows:
                self.begin += len(line) + 1
        if not rows and self.size is None:
            raise InputError("holds no events")
        self.order = _order_of(rows, named, source)
        times = {row[self.order.index("t")] for row in rows}
        self.micro = bool(times) and not any(set(time) & set(b".eE") for time in times)


def _order_of(rows: list[list[bytes]], named: str | None, source: Source | None) -> str:
    """Return the order of the columns: as the user says, as a line names them, or as the values tell."""
    if source is not None and source.columns is not None:
        return checked_order(source.columns)
    if named is not None:
        return named
    found = recognised_order(np.array(rows, "S40").astype(np.float64)) if rows else "txyp"
    if found is None:  # a line among these is no event: the decoder names it, if it is told how to read
        signs = {b"0", b"1", b"-1"}
        last, third = ({row[k] for row in rows} <= signs for k in (3, 2))
        return "txyp" if last or not third else "xypt"
    if found not in ("txyp", "xypt") and source is not None:
        note_order(source, found)
    return found


def _names_columns(line: bytes) -> bool:
    """Whether a line names the columns."""
    return bool(re.fullmatch(rb"[A-Za-z_ ,\t\[\]()]+\r?", line))


def matches_head(head: bytes) -> bool:
    """Whether these first bytes of a file are events as text."""
    if b"\0" in head[:64]:
        return False
    for line in head.split(b"\n")[:-1] or [head]:
        if line.startswith(b"#") or not line.strip() or _names_columns(line) or SIZE.fullmatch(line):
            continue
        return bool(LINE.fullmatch(line))
    return False


def decode_text(open_file: Callable[[], BinaryIO], source: Source | None = None) -> Iterator[Piece]:
    """Yield events [s] of a text; raises InputError with the number of a line that is none.

    Args:
        open_file: Opens the text.
        source: What the user says about it; gets a note of what was told from the values.
    """
    with open_file() as file:
        head = file.read(LIMITS.head)
        layout = Layout(head, source)
        line = head[: layout.begin].count(b"\n") + 1
        rest = head[layout.begin :]
        while block := file.read(LIMITS.block):
            text = rest + block
            end = text.rfind(b"\n") + 1
            if len(text) - end > LIMITS.line:
                raise InputError(f"line {line + text.count(10)} is longer than {LIMITS.line} bytes")
            if end:
                yield _decode_lines(text[:end], layout, line)
            line += text.count(b"\n", 0, end)
            rest = text[end:]
        if rest.strip():
            yield _decode_lines(rest + b"\n", layout, line)


def _decode_lines(text: bytes, layout: Layout, line: int) -> Piece:
    c = np.frombuffer(text, np.uint8)
    blank = (c == 32) | (c == 44) | (c == 9) | (c == 10) | (c == 13)
    edges = np.flatnonzero(blank[1:] != blank[:-1]) + 1
    if not blank[0]:
        edges = np.concatenate(([0], edges))
    begin, end = edges[::2], edges[1::2]  # the text ends with a newline
    begin, end = _split_rows(c, begin, end, text, line)
    k = [layout.order.index(letter) for letter in "txyp"]
    time = _parse_times(c, text, begin[:, k[0]], end[:, k[0]], layout.micro)
    x, y = (_parse_integers(c, begin[:, i], end[:, i], 6) for i in k[1:3])
    p = _parse_integers(c, begin[:, k[3]], end[:, k[3]], 2, signed=True)
    good = (time == time) & (x >= 0) & (x < 65536) & (y >= 0) & (y < 65536) & (p >= -1) & (p <= 1)
    if not good.all():
        first = int(begin[np.argmin(good), 0])
        raise _bad_line(text, first, line)
    return Piece(time, x.astype(np.uint16), y.astype(np.uint16), p)


def _bad_line(text: bytes, place: int, line: int) -> InputError:
    begin = text.rfind(b"\n", 0, place) + 1
    shown = text[begin : begin + 40].split(b"\n")[0].strip().decode("latin-1")
    return InputError(f"line {line + text.count(10, 0, place)} is not 't x y p': '{shown}'")


def _split_rows(
    c: NDArray[np.uint8], begin: NDArray[np.intp], end: NDArray[np.intp], text: bytes, line: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return begin and end of the first four words of each line, (N, 4); a fifth is v2e's label of noise."""
    newlines = np.flatnonzero(c == 10)
    upto = np.searchsorted(begin, newlines)
    count = np.diff(upto, prepend=0)
    width = 5 if len(begin) and count[count > 0].min() == 5 else 4
    wrong = np.flatnonzero((count != 0) & (count != width))
    if len(wrong):
        raise _bad_line(text, int(newlines[wrong[0]]), line)
    shape = (-1, width)
    return begin.reshape(shape)[:, :4], end.reshape(shape)[:, :4]


def _parse_integers(
    c: NDArray[np.uint8],
    begin: NDArray[np.intp],
    end: NDArray[np.intp],
    most: int,
    *,
    signed: bool = False,
) -> NDArray[np.int64]:
    """Return whole numbers of up to `most` characters, (N,); -2 where a word is none."""
    length = end - begin
    value = np.zeros(len(begin), np.int64)
    good = length <= most
    negative = c.take(begin) == 45 if signed else None
    for k in range(min(most, int(length.max(initial=0)))):
        digit = c.take(np.minimum(begin + k, end - 1)) - 48  # uint8: what is no digit becomes large
        within = length > k
        if negative is not None and k == 0:
            within = ~negative
        good &= ~within | (digit < 10)
        value = np.where(within, value * 10 + digit, value)
    if negative is not None:
        value = np.where(negative, -value, value)
    return np.where(good, value, -2)


def _parse_times(
    c: NDArray[np.uint8], text: bytes, begin: NDArray[np.intp], end: NDArray[np.intp], micro: bool
) -> NDArray[np.float64]:
    """Return decimal numbers [s], (N,); not a number where a word is none."""
    length = end - begin
    value = np.zeros(len(begin), np.int64)
    point = np.zeros(len(begin), np.int64)  # digits and one more since the point, 0 before it
    good = length <= LIMITS.digits
    for k in range(min(LIMITS.digits, int(length.max(initial=0)))):
        digit = c.take(np.minimum(begin + k, end - 1)) - 48
        within = length > k
        is_digit = (digit < 10) & within
        is_point = (digit == 254) & within & (point == 0)
        good &= is_digit | is_point | ~within
        value = np.where(is_digit, value * 10 + digit, value)
        point += (point > 0) & within | is_point
    powers = 10.0 ** np.arange(LIMITS.digits + 1)
    out = value / powers.take(np.maximum(point - 1, 0))
    slow = np.flatnonzero(~good | (value >= 2**53) | (length <= (point > 0)))
    for i in slow:
        word = text[begin[i] : end[i]]
        out[i] = float(word) if re.fullmatch(NUMBER, word) else np.nan
    if micro:
        out /= 1e6
    out[~np.isfinite(out)] = np.nan
    return out


def encode_events(
    t: NDArray[np.float64], x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.bool_]
) -> bytes:
    """Return lines `t x y p` of events (N,), with as many decimals of the time [s] as they need."""
    for decimals in (6, 9):
        whole = np.rint(t * 10.0**decimals)
        if np.all(whole / 10.0**decimals == t) and np.all((whole >= 0) & (whole < 2**53)):
            seconds, fraction = np.divmod(whole.astype(np.int64), 10**decimals)
            words = (_digits_of(seconds), b".", _digits_of(fraction, decimals))
            fields = (*words, b" ", _digits_of(x), b" ", _digits_of(y), b" ", _digits_of(p), b"\n")
            return _join_fields(len(t), fields)
    rows = zip(t.tolist(), x.tolist(), y.tolist(), p.tolist(), strict=True)
    return "".join(f"{a!r} {b} {c} {d:d}\n" for a, b, c, d in rows).encode()


def _digits_of(values: NDArray[np.generic], least: int = 1) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return the digits of whole numbers >= 0 (N,) as characters, and which of them to show, both (N, K)."""
    rest = values.astype(np.int64)
    width = max(least, len(str(int(rest.max(initial=0)))))
    out = np.empty((len(rest), width), np.uint8)
    show = np.empty((len(rest), width), np.bool_)
    for k in range(width - 1, -1, -1):
        show[:, k] = (rest > 0) | (k >= width - least)
        rest, digit = np.divmod(rest, 10)
        out[:, k] = digit + 48
    return out, show


def _join_fields(
    count: int, fields: tuple[bytes | tuple[NDArray[np.uint8], NDArray[np.bool_]], ...]
) -> bytes:
    """Return the fields of every line one after the other."""
    full = [
        (np.full((count, 1), ord(field), np.uint8), np.ones((count, 1), np.bool_))
        if isinstance(field, bytes)
        else field
        for field in fields
    ]
    characters, shown = (np.concatenate(arrays, axis=1) for arrays in zip(*full, strict=True))
    return bytes(characters[shown].tobytes())
