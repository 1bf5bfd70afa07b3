"""Sensor files edited in place: what the author wrote stays, what is asked for comes."""

from __future__ import annotations

import datetime

import cv2
import numpy as np
import pytest
from helpers.command_line import dase_here, refusal

from dase import InputError, Sensor, VideoScene, dump_sensor, io, load_sensor, simulate
from dase.diagnosis.sensor_update import round_parameters
from dase.effects import EFFECTS
from dase.simulation.sensor_edit import SensorText, history_entry_today, parse_values
from dase.simulation.sensor_file import parse_sensor, read_presets
from dase.simulation.sensor_history import HistoryEntry

MINE = """\
# my camera
name = "my camera"     # on the desk
size = [
  346,
  260,
]

# the threshold, from the edge recording
[threshold]       # log intensity
on   = 0.25       # strange spacing
off  = 0.22

# ---- noise ----

# leak: from the dark recording
# of last week
[leak]            # ON events at rest
rate = 0.1        # Hz
# end of leak

# about nothing

[ "refractory" ]
period = 0.001    # s
"""


def kept(before: str, after: str) -> bool:
    """Whether all lines of a text are in another, in the same order."""
    rest = iter(after.splitlines())
    return all(any(line == other for other in rest) for line in before.splitlines() if line.strip())


@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize("base", ["mine", "davis240c", "imx636"])
def test_add_then_remove(base, name):
    text = SensorText(MINE if base == "mine" else read_presets()[base], base)
    if name in text.sensor():
        with pytest.raises(InputError, match=f"{base} already has effect '{name}'"):
            text.with_effect(EFFECTS[name]())
        return
    effect = EFFECTS[name]()
    more = text.with_effect(effect).with_history(history_entry_today(f"add {name}"))
    assert more.sensor() == text.sensor().with_effect(effect)
    assert kept(text.text, more.text)
    less = more.without_effect(name)
    assert less.sensor() == text.sensor()
    assert kept(text.text, less.text)
    assert f"[{name}]" not in less.text


def test_place_and_comments():
    more = (
        SensorText(MINE, "mine")
        .with_effect(EFFECTS["bandwidth"]())
        .with_effect(EFFECTS["mismatch"](spread=0.2))
    )
    lines = [line for line in more.text.splitlines() if line.startswith(("[", "#"))]
    assert [line.split("]")[0].strip("[ ") for line in lines] == [
        "# my camera",
        "bandwidth",
        "# the threshold, from the edge recording",
        "threshold",
        "# ---- noise ----",
        "mismatch",
        "# leak: from the dark recording",
        "# of last week",
        "leak",
        "# end of leak",
        "# about nothing",
        '"refractory"',
    ]
    less = SensorText(MINE, "mine").without_effect("leak")
    for gone in ("leak", "of last week"):
        assert gone not in less.text
    assert kept("# ---- noise ----\n# about nothing\n", less.text)


def test_changed_values_keep_their_comments():
    text = SensorText(MINE, "mine")
    new = text.with_values_of(EFFECTS["threshold"](on=0.3, off=0.22, phase=0.5))
    assert new.sensor()["threshold"].on == 0.3
    assert "on   = 0.3       # fitted (was 0.25: strange spacing)" in new.text
    assert "phase = 0.5" in new.text
    old = [line for line in MINE.splitlines() if not line.startswith("on ")]
    assert kept("\n".join(old), new.text)


def test_becomes_another_sensor():
    text = SensorText(MINE, "mine")
    want = text.sensor().without("leak").with_effect(EFFECTS["shot"](rate=3.0))
    want = want.with_effect(EFFECTS["refractory"](period=0.002)).with_effect(EFFECTS["threshold"](on=0.3))
    new = text.describing(want)
    assert new.sensor() == want
    assert "period = 0.002    # s\n" in new.text
    assert "on   = 0.3       # fitted (was 0.25: strange spacing)" in new.text
    assert text.describing(text.sensor()).text == MINE


def test_rounded():
    sensor = round_parameters(Sensor().with_effect(EFFECTS["bandwidth"](cutoff=123.456789, dark=1 / 3)))
    assert (sensor["bandwidth"].cutoff, sensor["bandwidth"].dark) == (123.5, 0.3333)
    assert round_parameters(Sensor().with_effect(EFFECTS["bandwidth"](cutoff=float("inf"))))[
        "bandwidth"
    ].is_off()


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_ends_of_lines_stay(newline):
    text = SensorText(MINE.replace("\n", newline), "mine")
    for new in (
        text.with_effect(EFFECTS["shot"]()),
        text.without_effect("leak"),
        text.with_history(history_entry_today("nothing")),
    ):
        assert new.text.count("\n") == new.text.count(newline)


def test_history_stays_at_the_end_and_goes_round():
    entry = HistoryEntry(
        did="add shot",
        recording='a "quoted" one.h5',
        error_before=4.5,
        error_after=1.25,
        floor=1.0,
        dase="0.1.0",
        date=datetime.date(2021, 2, 3),
    )
    text = SensorText(MINE, "mine").with_effect(EFFECTS["shot"]()).with_history(entry)
    text = text.with_effect(EFFECTS["latency"]()).with_history(HistoryEntry(did="add latency"))
    assert text.text.index("[latency]") < text.text.index("[[history]]")
    sensor = text.sensor()
    assert sensor.history == (entry, HistoryEntry(did="add latency"))
    again = parse_sensor(dump_sensor(sensor), "dumped")
    assert again == sensor
    assert again.history == sensor.history
    assert sensor.without("shot").history == sensor.history
    assert Sensor() == Sensor(history=(entry,))


@pytest.mark.parametrize(
    ("history", "message"),
    [
        ("history = 3", r"must be tables \[\[history\]\]"),
        ("[history]\ndid = 'x'", r"must be tables \[\[history\]\]"),
        ("[[history]]\nfloor = 1.0", "must say what was done"),
        ("[[history]]\ndid = 3", "history.did must be a text, got 3"),
        ("[[history]]\ndid = 'x'\nfloor = 'y'", "history.floor must be a number, got 'y'"),
        ("[[history]]\ndid = 'x'\nflor = 1.0", "did you mean 'floor'?"),
    ],
)
def test_wrong_history(history, message):
    text = f"{history}\n[threshold]" if "[" not in history else f"[threshold]\n{history}"
    with pytest.raises(InputError, match=message):
        parse_sensor(text, "mine")


@pytest.mark.parametrize(
    "text",
    [
        "threshold = {on = 0.2}\nleak = {rate = 0.1}\n",
        "threshold.on = 0.2\nleak.rate = 0.1\n",
        'name = """\n[leak]\n"""\n[threshold]\n[leak]\n',
    ],
)
def test_what_cannot_be_edited_is_refused(text):
    for edit in (lambda t: t.without_effect("leak"), lambda t: t.with_effect(EFFECTS["mismatch"]())):
        with pytest.raises(InputError, match="write each effect as a table"):
            edit(SensorText(text, "mine"))


def test_values():
    assert parse_values(EFFECTS["refractory"], {"mode": "delay", "period": "2e-3"}).period == 0.002
    assert parse_values(EFFECTS["bandwidth"], {"cutoff": "inf"}).is_off()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("add", "mine.toml", "leak"), "mine.toml already has effect 'leak'"),
        (("add", "mine.toml", "jitter", "--set", "spread"), "PARAMETER=VALUE"),
        (("add", "mine.toml", "jitter", "--set", "sprad=1"), "no parameter 'sprad': did you mean 'spread'?"),
        (("add", "mine.toml", "jitter", "--set", "spread=a"), "jitter.spread must be a number, got 'a'"),
        (("remove", "mine.toml", "shot"), "mine.toml does not have effect 'shot'"),
        (("remove", "mine.toml", "threshold"), "needs the effect 'threshold'"),
        (("remove", "mine.toml", "leak", "-o", "no/x.toml"), "the folder 'no' does not exist"),
    ],
)
def test_wrong_command(arguments, message, tmp_path):
    (tmp_path / "mine.toml").write_text(MINE)
    assert message in refusal(*arguments, cwd=tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.toml"]
    assert (tmp_path / "mine.toml").read_text() == MINE


def test_commands(tmp_path):
    (tmp_path / "mine.toml").write_text(MINE)
    done = dase_here("add", "mine.toml", "jitter", "--set", "spread=0.3", "-o", "more.toml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "more.toml: jitter added (spread 0.3)" in done.stdout
    more = load_sensor(tmp_path / "more.toml")
    assert more["jitter"].spread == 0.3
    assert more.history[-1].did == "add jitter"
    # in place, and to the standard output
    done = dase_here("remove", "more.toml", "leak", "-o", "more.toml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "leak" not in load_sensor(tmp_path / "more.toml")
    printed = dase_here("add", "dvs128", "flicker", cwd=tmp_path).stdout
    assert parse_sensor(printed, "printed") == load_sensor("dvs128").with_effect(EFFECTS["flicker"]())
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine.toml", "more.toml"]


@pytest.mark.slow
def test_add_and_fit(tmp_path, rng):
    """What is added to the model is found in a recording of it, and the fall of the error is written down."""
    t = np.arange(600) * 1e-3
    texture = cv2.GaussianBlur(rng.random((32, 400)).astype(np.float32), (0, 0), 2)
    texture = np.clip((texture - texture.min()) / np.ptp(texture), 0.03, 1)
    frames = np.stack([texture[:, round(200 * time) :][:, :32] for time in t])
    frames = np.round(255 * frames).astype(np.uint8)
    np.savez(tmp_path / "clip.npz", frames=frames, frame_us=np.round(t * 1e6).astype(np.int64))
    truth = Sensor().with_effect(EFFECTS["leak"](rate=8.0))
    events = simulate(VideoScene(frames / np.float32(255), t), truth, seed=3)
    io.write(tmp_path / "recording.h5", io.Sequence(events))
    (tmp_path / "mine.toml").write_text("[threshold]\non = 0.2 # mine\noff = 0.2\n")
    options = ("--fit", "recording.h5", "--scene", "clip.npz", "-o", "mine.toml")
    done = dase_here("add", "mine.toml", "leak", *options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    sensor = load_sensor(tmp_path / "mine.toml")
    # a share that grows with the light and one that does not are alike where the light is much the same
    leak = sensor["leak"]
    assert leak.rate * (1 + leak.light * frames.mean() / 255) == pytest.approx(8.0, rel=0.15)
    assert sensor["threshold"].on == pytest.approx(0.2, rel=0.05)
    entry = sensor.history[-1]
    assert entry.recording == "recording.h5"
    assert entry.error_before > 2 * entry.error_after
    assert f"error {entry.error_before:.2f} before" in done.stdout
    assert "# fitted (was 0.2: mine)" in (tmp_path / "mine.toml").read_text()
    assert "none.h5" in refusal("add", "mine.toml", "shot", "--fit", "none.h5", cwd=tmp_path)


def test_adding_what_another_effect_does_as_well_says_so(tmp_path):
    said = dase_here("add", "davis346", "second_order", "-o", tmp_path / "poles.toml").stderr
    assert "note: bandwidth acts beside second_order, which does the same and more" in said
    sensor = load_sensor(tmp_path / "poles.toml")
    assert sensor.doubled_effects() == {"bandwidth": "second_order"}
    assert not sensor.with_effect(EFFECTS["bandwidth"].identity()).doubled_effects()
    assert not load_sensor("davis346").doubled_effects()


def test_adding_a_dark_current_says_what_it_takes_the_place_of(tmp_path):
    said = dase_here("add", "davis346", "dark", "-o", tmp_path / "dark.toml").stderr
    assert "note: bandwidth.dark changes nothing beside dark" in said
    assert not dase_here("add", "davis346", "linlog", "-o", tmp_path / "linlog.toml").stderr
