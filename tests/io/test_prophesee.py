"""Prophesee's files, word by word: every kind of word, counters that start over, headers."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.sample_files import H, W, events, evt21, microseconds

from dase import io
from dase.errors import InputError
from dase.events import Events
from dase.io import evt2, evt3, raw
from dase.io.binary import Rollover
from dase.io.sequence import Sequence

EVT3_HEADER = b"% evt 3.0\n% format EVT3;height=720;width=1280\n% end\n"


def evt3_words(*words):
    """Words as (kind, value)."""
    return np.array([kind << 12 | value for kind, value in words], "<u2").tobytes()


def read_words(tmp_path, header, data, **options):
    (tmp_path / "a.raw").write_bytes(header + data)
    got = io.read(tmp_path / "a.raw", **options).events
    return [(round(t * 1e6), x, y, p) for t, x, y, p in zip(got.t, got.x, got.y, got.p, strict=True)]


def evt3_twin(words):
    """Decode EVT3 one word after the other."""
    out, turns, high, low, y, base, on = [], 0, None, 0, None, None, False
    for word in words:
        kind, value = int(word) >> 12, int(word) & 4095
        if kind == 8:
            if high is not None:
                turns += (value - high < -2048) - (value - high > 2048)
            low = low if value == high else 0
            high = value
        elif kind == 6:
            low = value
        elif kind in (0, 1):
            y = value & 2047 if kind == 0 else None
        elif kind == 3:
            base, on = value & 2047, value > 2047
        elif kind in (2, 4, 5):
            t = None if high is None else (turns << 24) + (high << 12) + low
            bits = [0] if kind == 2 else [i for i in range(12 if kind == 4 else 8) if value >> i & 1]
            x, p = (value & 2047, value > 2047) if kind == 2 else (base, on)
            out += [(t, x + i, y, p) for i in bits if None not in (t, x, y)]
            if kind > 2 and base is not None:
                base += 12 if kind == 4 else 8
    return [event for event in out if event[1] < 1280 and event[2] < 720]


def test_evt3_word_by_word(tmp_path):
    data = evt3_words(
        (2, 5),  # before any time or row: skipped
        (0, 100), (6, 7), (2, 6),  # before the first TIME_HIGH: skipped
        (8, 1), (6, 20), (2, 0x800 | 10), (2, 11),  # ON at 10, OFF at 11
        (8, 1), (2, 12),  # a repeated TIME_HIGH keeps the low bits
        (8, 2), (2, 13),  # a new one clears them
        (0, 0x800 | 101), (2, 14),  # the camera bit is no part of the row
        (3, 0x800 | 200), (4, 0b100000000101), (5, 0xF81), (4, 1),  # vectors 12, 8, 12; 8 has 4 unused bits
        (1, 102), (2, 15), (0, 103),  # not a change of contrast
        (10, 3), (14, 20), (15, 4095), (7, 5), (6, 4095), (2, 16),  # what is skipped
    )  # fmt: skip
    on, off = True, False
    want = [(4116, 10, 100, on), (4116, 11, 100, off), (4116, 12, 100, off), (8192, 13, 100, off)]
    want += [(8192, 14, 101, off)] + [(8192, x, 101, on) for x in (200, 202, 211, 212, 219, 220)]
    want += [(8192 + 4095, 16, 103, off)]
    notes = []
    assert read_words(tmp_path, EVT3_HEADER, data, notes=notes) == want
    assert "2 event words before the first time word: skipped" in notes
    assert "1 events lie outside the 1280x720 sensor: skipped" in notes  # the one without a row of changes
    assert evt3_twin(np.frombuffer(data, "<u2")) == want


@pytest.mark.parametrize("part", [1, 3, 64, 1 << 18])
def test_evt3_equals_its_twin_on_random_words_whatever_is_decoded_at_once(tmp_path, rng, monkeypatch, part):
    monkeypatch.setattr(evt3, "PART", part)
    kinds = rng.choice(
        [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 14, 15], 3000, p=np.array([4, 1, 6, 3, 6, 6, 8, 1, 2, 1, 1, 1]) / 40
    )
    values = rng.integers(0, 4096, 3000)
    steps = np.cumsum(rng.integers(0, 1500, 3000))  # TIME_HIGH starts over often
    values[kinds == 8] = steps[kinds == 8] & 4095
    words = (kinds << 12 | values).astype("<u2")
    want = evt3_twin(words)
    (tmp_path / "a.raw").write_bytes(EVT3_HEADER + words.tobytes())
    notes = []
    pieces = list(evt3.read_pieces(io.Source(tmp_path / "a.raw", notes=notes)))
    t, x, y, p = (np.concatenate(column) for column in zip(*(piece[:4] for piece in pieces), strict=True))
    keep = (x < 1280) & (y < 720)
    got = list(zip(t[keep].tolist(), x[keep].tolist(), y[keep].tolist(), p[keep].tolist(), strict=True))
    assert got == want
    assert len(want) > 250
    assert f"{np.count_nonzero(kinds == 9)} words of unknown type: skipped" in notes


def test_evt3_survives_one_damaged_time(tmp_path):
    data = evt3_words((0, 1), (8, 5), (2, 1), (8, 4000), (2, 2), (8, 5), (6, 9), (2, 3))
    assert [t for t, *_ in read_words(tmp_path, EVT3_HEADER, data)] == [(4000 - 4096) << 12, 20480, 20489]


def test_evt2_word_by_word(tmp_path):
    def word(kind, time, x, y):
        return kind << 28 | time << 22 | x << 11 | y

    words = [word(1, 3, 1, 2), 8 << 28 | 5, word(1, 63, 639, 479), word(0, 0, 7, 8), 10 << 28, 14 << 28]
    words += [15 << 28, 3 << 28, 8 << 28 | 0xFFFFFFF, word(0, 1, 9, 9), 8 << 28, word(1, 2, 4, 4)]
    notes = []
    header = b"% evt 2.0\n% system_ID 21\n"
    got = read_words(tmp_path, header, np.array(words, "<u4").tobytes(), notes=notes)
    top = 0xFFFFFFF << 6
    assert got == [
        (5 * 64, 7, 8, False),
        (5 * 64 + 63, 639, 479, True),
        (top + 1, 9, 9, False),
        (top + 64 + 2, 4, 4, True),
    ]
    assert "1 events before the first time word: skipped" in notes
    assert "1 words of unknown type: skipped" in notes


@pytest.mark.parametrize(("legacy", "said"), [(False, True), (True, True), (False, False), (True, False)])
def test_evt21_masks_and_order_of_halves(tmp_path, rng, legacy, said):
    e = events(rng, 400)
    evt21(tmp_path / "a.raw", e, legacy=legacy, said=said)
    data = bytearray((tmp_path / "a.raw").read_bytes())
    start = raw.parse_header(bytes(data)).length
    halves = np.frombuffer(data, "<u4", offset=start).reshape(-1, 2)
    halves[-1, 1 if legacy else 0] = 0x80000001  # the last word now holds two events
    (tmp_path / "a.raw").write_bytes(data)
    got = io.read(tmp_path / "a.raw", size=(2048, 2048)).events
    base = int(e.x[-1]) // 32 * 32
    assert got.x[-2:].tolist() == [base, base + 31]
    np.testing.assert_array_equal(got.x[:-2], e.x[:-1])
    np.testing.assert_array_equal(got.t[:-2], e.t[:-1])


@pytest.mark.parametrize("format", ["EVT2", "EVT3"])
def test_gaps_longer_than_the_counter_are_bridged(tmp_path, rng, format):
    gaps = np.array([0.0, 20.0, 20.0, 3600.0, 8000.0, 17_000.0, 40_000.0, 40_000.000001])
    n = np.zeros(len(gaps), np.uint16)
    e = Events(gaps, n, n, n > 0, W, H)
    io.write(tmp_path / "a.raw", Sequence(e), format=format)
    np.testing.assert_array_equal(io.read(tmp_path / "a.raw").events.t, gaps)


def test_dat_versions_and_start_over(tmp_path):
    def record(t, x, y, p, bits):
        return [t, x | y << bits[0] | p << sum(bits)]

    for version, bits in ((1, (9, 8)), (2, (14, 14))):
        rows = [record(2**32 - 5, 300, 200, 1, bits), record(3, 1, 2, 0, bits)]
        header = f"% Version {version}\n% Height 240\n% Width 304\n".encode() + bytes((12, 8))
        (tmp_path / "a.dat").write_bytes(header + np.array(rows, "<u4").tobytes() + b"abc")
        notes = []
        got = io.read(tmp_path / "a.dat", notes=notes).events
        assert (got.t * 1e6).round().tolist() == [2**32 - 5, 2**32 + 3]
        assert (got.x.tolist(), got.y.tolist(), got.p.tolist()) == ([300, 1], [200, 2], [True, False])
        assert (got.width, got.height) == (304, 240)
        assert notes == ["3 bytes at the end are no whole record of 8 bytes: skipped"]
    (tmp_path / "a.dat").write_bytes(b"% Version 7\n" + bytes((12, 8)))
    with pytest.raises(InputError, match="DAT version 7"):
        io.read(tmp_path / "a.dat")


def test_counters():
    values = np.array([250, 255, 3, 2, 100, 250, 1])
    assert Rollover(8)(values).tolist() == [250, 255, 259, 258, 356, 506, 513]
    once = Rollover(8, back=True)
    parts = [once(values[k : k + 1])[0] for k in range(len(values))]
    assert parts == Rollover(8, back=True)(values).tolist() == [250, 255, 259, 258, 356, 250, 257]
    assert Rollover(8)(values[:0]).tolist() == []


@pytest.mark.parametrize(
    ("text", "encoding", "size"),
    [
        ("% evt 3.0\n% geometry 1280x720\n", "EVT3", (1280, 720)),
        ("% format EVT21;endianness=legacy;height=320;width=320\n% evt 2.1\n% end\n", "EVT21", (320, 320)),
        ("% evt 2.0\n% system_ID 49\n", "EVT2", (1280, 720)),
        ("% Date 2020\n% evt 2.0\n", "EVT2", None),
        ("% format EVT4;height=1;width=1\n", "EVT4", (1, 1)),
        ("% geometry 99999999999x1\n", None, None),
        ("%\x00\x01\x02\n", None, None),
        ("no header\n", None, None),
    ],
)
def test_headers(text, encoding, size):
    header = raw.parse_header(text.encode("latin-1") + b"%\x80\x00\x0a\x00")
    assert (header.encoding, header.size) == (encoding, size)
    assert header.length in (len(text), 0)


def test_headers_that_do_not_help(tmp_path):
    for head, match in (
        (b"% evt 4.0\n", "does not name"),
        (b"% format AER-8b\n", "AER-8B"),
        (b"", "does not name"),
    ):
        (tmp_path / "a.raw").write_bytes(head + bytes(64))
        with pytest.raises(InputError, match=match):
            io.read(tmp_path / "a.raw")


@pytest.mark.parametrize("name", ["EVT2", "EVT3"])
def test_a_second_library_reads_the_same(tmp_path, rng, name):
    evlib = pytest.importorskip("evlib", reason="needs evlib, a second reader of EVT")
    e = events(rng, 2000)
    io.write(tmp_path / "a.raw", Sequence(e), format=name)
    rows = evlib.load_events(str(tmp_path / "a.raw")).collect()
    t = rows["t"].dt.total_microseconds().to_numpy()
    got = sorted(zip(t, rows["x"], rows["y"], rows["polarity"].to_numpy() > 0, strict=True))
    want = sorted(zip(microseconds(e), e.x, e.y, e.p, strict=True))  # evlib reorders what is simultaneous
    assert got == want


def test_decoders_carry_nothing_but_what_the_format_says():
    words = np.array([8 << 28 | 1, 1 << 28 | 5 << 11 | 6], np.uint32)
    decoder = evt2.Decoder()
    assert [len(piece.t) for piece in decoder(words)] == [1]
    (piece,) = decoder(words[1:])
    assert piece.t.tolist() == [64]


@pytest.mark.parametrize("name", ["psee_gen3_evt2.raw", "psee_hd_evt3.raw"])
def test_a_second_library_reads_the_same_of_a_camera(shared, name):
    evlib = pytest.importorskip("evlib", reason="needs evlib, a second reader of EVT")
    path = shared / "recordings/native" / name
    e = io.read(path).events
    rows = evlib.load_events(str(path)).collect()
    t = rows["t"].dt.total_microseconds().to_numpy()
    got = np.stack([t - t[0], rows["x"], rows["y"], rows["polarity"].to_numpy() > 0])
    want = np.stack([microseconds(e) - microseconds(e)[0], e.x, e.y, e.p])
    order, wanted = (np.lexsort(columns[::-1]) for columns in (got, want))
    np.testing.assert_array_equal(got[:, order], want[:, wanted])
