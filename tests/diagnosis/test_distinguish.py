"""Which recording tells two models apart."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.command_line import dase_here, refusal
from scipy.stats import norm

from dase import InputError, Sensor
from dase.cli.stimulus import stimulus_command
from dase.datasets.stimulus_files import PROTOCOLS, SHEETS, VIDEOS
from dase.diagnosis.distinguish import distinguish, separating_power, table_rows
from dase.diagnosis.standard_stimuli import STANDARD_STIMULI
from dase.effects import EFFECTS
from dase.probes.statistics import FAMILIES, FAMILY_WORDS
from dase.scenes.screen_stimulus import PARTS

QUICK = {"pixels": 200, "repeats": 12, "longest": 1.0}


def with_(**effects) -> Sensor:
    sensor = Sensor()
    for name, values in effects.items():
        sensor = sensor.with_effect(EFFECTS[name](**values))
    return sensor


def of(found, stimulus):
    return next(answer for answer in found.answers if answer.stimulus == stimulus)


def test_every_family_has_words():
    assert set(FAMILY_WORDS) == set(FAMILIES)


@pytest.mark.parametrize("standard", STANDARD_STIMULI, ids=lambda standard: standard.name)
def test_the_command_of_a_stimulus_is_one(standard):
    program, name, *arguments = standard.command.split()
    assert (program, name) == ("dase", "stimulus")
    given = stimulus_command.make_context("stimulus", arguments).params
    assert given["out"].suffix in (*VIDEOS, *SHEETS, *PROTOCOLS)
    if given["parts"] is not None:
        assert set(given["parts"]) <= set(PARTS)


def test_power_of_a_known_difference(rng):
    """One statistic that differs among many that do not: never above the best test, and not far below it."""
    for shift in (2.0, 3.3, 4.5):
        powers = []
        for _ in range(40):
            a, b = rng.normal(size=(2, 24, 100))
            b[:, 7] += shift
            power, say = separating_power(a, b, np.zeros(100))
            powers.append(power)
            assert np.argmax(say) == 7
        best = norm.cdf(shift - norm.ppf(0.95))
        assert best - 0.2 < np.mean(powers) < best + 0.03


def test_no_difference_is_never_told(rng):
    powers = [separating_power(*rng.normal(size=(2, 24, 300)), np.zeros(300))[0] for _ in range(200)]
    assert max(powers) < 0.6


def test_tolerated_differences_do_not_count(rng):
    a, b = 1e-3 * rng.normal(size=(2, 24, 50))
    assert separating_power(a, b + 0.01, np.zeros(50))[0] > 0.99
    assert separating_power(a, b + 0.01, np.full(50, 0.1))[0] < 0.2


def test_statistics_that_do_not_vary():
    a, b = np.zeros((24, 3)), np.ones((24, 3))
    assert separating_power(a, a, np.zeros(3))[0] == pytest.approx(0.05)
    assert separating_power(a, b, np.full(3, 0.01))[0] > 0.99


def test_noise_at_rest_is_seen_at_rest():
    found = distinguish(with_(), with_(shot={"rate": 2.0, "bright": 0.0}), **QUICK)
    dark = of(found, "static dark")
    # 400 events per second where the other model has none
    assert dark.seconds == 0.2
    assert dark.rates[:2] == (0.0, 0.0)
    assert dark.rates[2] + dark.rates[3] == pytest.approx(2.0, rel=0.2)
    # A dark scene is the first of those that tell as soon
    assert found.best == dark
    assert "Record static dark for 0.2 s" in found.sentence
    assert "how many events come" in found.sentence
    assert "dase stimulus protocol.md" in found.sentence


def test_the_duration_follows_the_rate():
    """With n expected events against none, one event at least comes in 95 of 100 recordings from n = 3 on."""
    found = distinguish(
        with_(), with_(shot={"rate": 0.02, "bright": 1.0}), pixels=400, repeats=24, longest=5.0
    )
    dark = of(found, "static dark")
    expected = 0.02 * 400 * dark.seconds
    assert 3 <= expected <= 45
    assert dark.tried[0][1] < 0.95
    assert [seconds for seconds, _ in dark.tried] == [0.2, 0.5, 1.0, 2.0, 5.0][: len(dark.tried)]


def test_bandwidth_is_seen_at_edges_only():
    slow, fast = (with_(bandwidth={"cutoff": cutoff, "dark": 1.0}) for cutoff in (20.0, 200.0))
    found = distinguish(slow, fast, **QUICK)
    assert of(found, "static dark").seconds is None
    assert of(found, "static bright").seconds is None
    assert of(found, "fast edge").seconds is not None


def test_identical_models_are_indistinguishable():
    model = with_(leak={"rate": 1.0}, shot={"rate": 1.0}, mismatch={})
    found = distinguish(model, model, **QUICK)
    assert found.best is None
    assert all(answer.seconds is None and answer.tried[-1][0] == 1.0 for answer in found.answers)
    assert "indistinguishable in any of these recordings up to 1 s" in found.sentence
    assert len(list(table_rows(found, "a", "b"))) == 1 + len(STANDARD_STIMULI)


def test_clocks_and_busses_are_seen():
    """A slow clock tells at once; a bus does where it is full, at fast edges and not at rest."""
    ticks = distinguish(with_(), with_(timestamp={"step": 1e-4}), **QUICK | {"longest": 0.2})
    assert of(ticks, "fast edge").seconds == 0.2
    assert "clock" in of(ticks, "fast edge").differs
    quiet = {"shot": {"rate": 1.0, "bright": 1.0}}
    bus = with_(**quiet, readout={"rate": 1e6, "depth": 10.0, "mode": "drop"})
    found = distinguish(with_(**quiet), bus, **QUICK | {"longest": 0.5})
    assert of(found, "static dark").seconds is None
    assert of(found, "fast edge").seconds is not None


def test_a_readout_that_both_have_tells_nothing():
    model = with_(timestamp={"step": 1e-4}, shot={"rate": 1.0})
    assert distinguish(model, model, **QUICK | {"longest": 0.2}).best is None


@pytest.mark.parametrize(
    ("a", "b", "options", "message"),
    [
        (Sensor(size=(4, 4)), Sensor(size=(4, 5)), {}, "sizes are 4x4 and 4x5"),
        (Sensor(log_eps=0.1), Sensor(), {}, "log_eps must be the same"),
        (Sensor(), Sensor(), {"longest": math.nan}, "longest must lie in"),
        (Sensor(), Sensor(), {"pixels": 0}, "pixels must be >= 16"),
        (Sensor(), Sensor(), {"repeats": 2}, "repeats must be >= 8"),
        (Sensor(), Sensor(), {"device": "tpu"}, "'tpu' does not exist"),
    ],
)
def test_wrong_arguments(a, b, options, message):
    with pytest.raises(InputError, match=message):
        distinguish(a, b, **options)


@pytest.mark.slow
def test_command(tmp_path):
    for name, rate in (("one", 0.0), ("two", 5.0)):
        (tmp_path / f"{name}.toml").write_text(f"[threshold]\n[shot]\nrate = {rate}\n")
    small = ("--longest", 0.2, "--pixels", 100)
    done = dase_here("distinguish", "one.toml", "two.toml", *small, "-o", "powers.png", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Record static dark for 0.2 s" in done.stdout
    assert "one and two differ" in done.stdout
    assert (tmp_path / "powers.png").stat().st_size > 10_000
    assert "none.toml does not exist" in refusal("distinguish", "one.toml", "none.toml", cwd=tmp_path)
    wrong = refusal("distinguish", "one.toml", "two.toml", "-o", "powers.gif", cwd=tmp_path)
    assert "must end with .png" in wrong
