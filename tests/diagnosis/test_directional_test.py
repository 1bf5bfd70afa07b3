"""What chance hides, which candidate is taken, and what a review drops."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

import dase
from dase.diagnosis import pruning as reviewing
from dase.diagnosis.candidates import Candidate
from dase.diagnosis.directional_test import (
    RepeatCloud,
    _most_deviating_effect,
    deviation_towards,
    find_hidden_effect,
)
from dase.diagnosis.effect_search import _simplest_of_the_best
from dase.diagnosis.explain_effect import moving_bars
from dase.diagnosis.settings import DEFAULTS
from dase.diagnosis.state import DiagnosisTask, SearchPath
from dase.effects import EFFECTS
from dase.fitting.data_split import split_measurement
from dase.fitting.measurement import Measurement
from dase.fitting.model import FittedModel, model_of
from dase.probes.distance import Judgement
from dase.simulation.sensor import Sensor

MISMATCH, JITTER = EFFECTS["mismatch"](spread=0.15), EFFECTS["jitter"](spread=0.25)
TRUE = Sensor((EFFECTS["threshold"](on=0.18, off=0.2),)).with_effect(MISMATCH)
LIBRARY = {name: EFFECTS[name] for name in ("threshold", "mismatch", "jitter", "leak", "shot", "linlog")}


def judged(error: float, level: float = 0.2, reach: float = 0.4) -> Judgement:
    return Judgement(error, 1.15, reach, level, {}, {}, np.zeros(1), 1.0)


def test_the_distance_along_a_way_is_in_deviations_of_repeats(rng):
    repeats = 0.8 * rng.standard_normal((400, 60))  # the rest of a standard error is tolerance
    ways = rng.standard_normal((300, 60))
    seen = rng.standard_normal((2000, 60))
    far = np.array([RepeatCloud(repeats).deviations_along(ways[:1], one)[0] for one in seen])
    assert far.std() == pytest.approx(1.0, abs=0.07)
    assert abs(far.mean()) < 0.15
    way = ways[0]
    moved = RepeatCloud(repeats).deviations_along(ways, 4 * way / np.linalg.norm(way))
    assert moved[0] == pytest.approx(4.0, abs=0.3)
    assert np.abs(moved[1:]).max() < 2.5


def test_no_single_statistic_decides_and_no_chance_is_no_certainty():
    way, alike = np.ones((1, 25)), np.zeros((60, 25))
    assert RepeatCloud(alike).deviations_along(way, np.eye(25)[0] * 100)[0] == pytest.approx(
        DEFAULTS.hidden.most_of_one / 5
    )
    assert RepeatCloud(alike).deviations_along(way, np.full(25, 0.5))[0] == pytest.approx(2.5)


@pytest.fixture(scope="module")
def searches(device) -> dict[str, DiagnosisTask]:
    scene = moving_bars()
    out = {}
    for name, sensor in (("plain", TRUE), ("uneven", TRUE.with_effect(JITTER))):
        events = dase.simulate(scene, sensor, seed=4, device=device)
        evidence = split_measurement(Measurement(events, scene), pixels=900, seed=1, device=device)
        out[name] = DiagnosisTask(
            evidence, LIBRARY, 1, lambda text, share, error: None, frozenset({"threshold"})
        )
    return out


def test_jitter_is_seen_beside_mismatch_and_not_where_there_is_none(searches):
    model = model_of(TRUE)
    assert _most_deviating_effect(searches["plain"], model) is None
    name, start, p_value = _most_deviating_effect(searches["uneven"], model)
    assert name == "jitter"
    assert p_value == pytest.approx(1 / 61)  # none of the repeats is as far on any way
    assert 0.1 < start.sensor["jitter"].spread < 0.5
    true = model_of(TRUE.with_effect(JITTER))
    uneven, plain, hidden = searches["uneven"], searches["plain"], DEFAULTS.hidden
    assert deviation_towards(uneven, uneven.evidence.train, model, true) > hidden.away
    assert deviation_towards(uneven, uneven.evidence.held, model, true) > hidden.away_held_out
    assert deviation_towards(plain, plain.evidence.held, model, true) < hidden.away_held_out


def test_nothing_is_looked_at_where_chance_hides_nothing(searches):
    search = searches["uneven"]
    before = search.evidence.evaluations
    for judgement in (judged(0.3, level=0.1), judged(1.2, level=0.4, reach=0.7), judged(2.0, reach=3.0)):
        assert find_hidden_effect(search, model_of(TRUE), judgement) is None
    assert search.evidence.evaluations == before


def tried(name: str, error: float, parameters: int = 2, includes: tuple[str, ...] = ()) -> Candidate:
    space = SimpleNamespace(sensor={name: SimpleNamespace(includes=includes)})
    return Candidate(name, FittedModel(space, np.zeros(parameters)), 0.0, judgement=judged(error))


def test_the_simplest_of_those_that_are_not_told_apart_is_chosen():
    best, ties = _simplest_of_the_best([tried("a", 0.3, 4), tried("b", 0.5, 2), tried("c", 0.6, 3)])
    assert best.name == "b"
    assert ties == ("a", "c")
    best, ties = _simplest_of_the_best([tried("a", 0.3, 4), tried("b", 0.7, 2)])  # more than TIE behind
    assert (best.name, ties) == ("a", ())
    best, ties = _simplest_of_the_best(
        [tried("a", 0.9, 4), tried("b", 1.2, 2)]
    )  # not at the floor, the first is
    assert (best.name, ties) == ("a", ())
    best, ties = _simplest_of_the_best(
        [tried("a", 5.0, 4), tried("b", 5.4, 2)]
    )  # far off, a tenth is no difference
    assert (best.name, ties) == ("b", ("a",))
    # two poles in steps have no more freedom than one
    for includes, name in (((), "a"), (("b",), "b"), (("c",), "a")):
        assert _simplest_of_the_best([tried("a", 3.0, 2, includes), tried("b", 3.3)])[0].name == name


def fake(names: str, errors: dict[str, float], monkeypatch, **more) -> tuple:
    """Return a search and a model of effects of one letter each, whose errors are given."""

    def model(names: str) -> SimpleNamespace:
        sensor = SimpleNamespace(effects=[SimpleNamespace(name=n) for n in names])
        sensor.without = lambda name: model(names.replace(name, ""))
        place = np.zeros(len(names) + 2 * ("Z" in names))
        return SimpleNamespace(
            names=names, sensor=Names(names), space=SimpleNamespace(sensor=sensor), place=place
        )

    class Names(str):
        def without(self, name: str) -> str:
            return self.replace(name, "")

        def __getitem__(self, name: str) -> SimpleNamespace:
            less = tuple(SimpleNamespace(name=n) for n in simpler.get(name, ""))
            return SimpleNamespace(longest_step=lambda: steps.get(name, 1.0), simpler=lambda: less)

    steps: dict[str, float] = more.pop("steps", {})
    simpler: dict[str, str] = more.pop("simpler", {})
    task = SimpleNamespace(
        judge=lambda m: judged(errors[m.names]), added_to=lambda m: tuple(m.names),
        settings=DEFAULTS, evidence=None, seed=0, effects=more.pop("effects", {}),
    )  # fmt: skip
    monkeypatch.setattr(reviewing, "refit_model", lambda evidence, m, seed: m)
    monkeypatch.setattr(reviewing, "_is_much_to_simulate", lambda task, m: False)
    monkeypatch.setattr(reviewing, "_keep_near_models", lambda task, ways, judgement: ways)
    monkeypatch.setattr(reviewing, "with_same_freedom", lambda sensor, m, more: model(str(sensor)))
    monkeypatch.setattr(
        reviewing, "_droppable_models",
        lambda task, m: {n: model(m.names.replace(n, "")) for n in m.names},
    )  # fmt: skip
    monkeypatch.setattr(
        reviewing,
        "_rival_models",
        lambda task, path, m, n: {o: model(m.names.replace(n, o)) for o in rivals.get(n, "")},
    )
    rivals: dict[str, str] = more.pop("rivals", {})
    return task, SearchPath(), model(names), judged(errors[names])


def test_what_is_not_needed_is_dropped(monkeypatch):
    asked = fake("ab", {"ab": 0.3, "a": 0.35, "b": 6.0}, monkeypatch)
    left, after = reviewing.prune_model(*asked)
    assert (left.names, after.error) == ("a", 0.35)


def test_what_needs_the_finest_steps_is_tried_without_first_and_no_fine_model_is_fitted(monkeypatch):
    errors = {"abc": 0.3, "ab": 6.0, "ac": 6.0, "bc": 6.0}
    asked = fake("abc", errors, monkeypatch, steps={"b": 1e-3})
    fitted = []
    monkeypatch.setattr(reviewing, "refit_model", lambda evidence, m, seed: fitted.append(m.names) or m)
    reviewing.prune_model(*asked)
    assert fitted == ["ac", "bc", "ab"]
    monkeypatch.setattr(reviewing, "_is_much_to_simulate", lambda task, m: "b" in m.names)
    fitted.clear()
    reviewing.prune_model(*asked)
    assert fitted == ["ac"]


def test_noise_of_some_kilohertz_is_much_to_simulate():
    search = SimpleNamespace(evidence=SimpleNamespace(when=1e-3 * np.arange(9)), settings=DEFAULTS)
    for cutoff, much in ((100.0, False), (3000.0, True)):
        noisy = model_of(TRUE.with_effect(EFFECTS["voltage_noise"](cutoff=cutoff)))
        assert reviewing._is_much_to_simulate(search, noisy) is much


def test_what_is_not_needed_is_dropped_although_a_fit_without_it_ends_worse_by_chance(monkeypatch):
    """A share of hot pixels, fitted anew to a dozen, was half of what it was beside the other effect."""
    errors = {"ab": 0.3, "a": 0.35, "a again": 1.7, "b": 6.0, "b again": 6.0}
    asked = fake("ab", errors, monkeypatch)
    again = lambda evidence, m, seed: SimpleNamespace(names=f"{m.names} again")  # noqa: E731
    monkeypatch.setattr(reviewing, "refit_model", again)
    left, after = reviewing.prune_model(*asked)
    assert (left.names, after.error) == ("a", 0.35)


def test_what_is_far_from_the_floor_is_not_reviewed(monkeypatch):
    far = DEFAULTS.pruning.lost * judged(0.3).gate
    errors = {"a": 0.3, "b": 6.0}
    assert reviewing.prune_model(*fake("ab", {**errors, "ab": far - 0.1}, monkeypatch))[0].names == "a"
    assert reviewing.prune_model(*fake("ab", {**errors, "ab": far + 0.1}, monkeypatch))[0].names == "ab"


def test_what_accounts_for_most_stays_and_so_does_what_only_a_closer_look_shows(monkeypatch):
    asked = fake("ab", {"ab": 0.3, "a": 0.8, "b": 6.0}, monkeypatch)
    assert reviewing.prune_model(*asked)[0].names == "ab"
    asked = fake("ab", {"ab": 0.3, "a": 0.35, "b": 6.0}, monkeypatch)
    monkeypatch.setattr(reviewing, "lacks_effect_of", lambda task, less, without, m: less.names == "a")
    assert reviewing.prune_model(*asked)[0].names == "ab"


def test_a_simpler_rival_takes_the_place(monkeypatch):
    errors = {"aZ": 0.3, "Z": 9.0, "a": 9.0, "ab": 0.4, "b": 9.0}
    asked = fake("aZ", errors, monkeypatch, rivals={"Z": "b"})
    left, after = reviewing.prune_model(*asked)
    assert (left.names, after.error) == ("ab", 0.4)
    # one that is no simpler does not
    errors = {"ac": 0.3, "c": 9.0, "a": 9.0, "ab": 0.4, "b": 9.0}
    asked = fake("ac", errors, monkeypatch, rivals={"c": "b"})
    assert reviewing.prune_model(*asked)[0].names == "ac"


def test_what_includes_an_effect_must_do_better_than_it(monkeypatch):
    """A second order so damped that it is one pole came to 1.1 where a clip of v2e had the pole at 1.4."""
    errors = {"ab": 1.4, "a": 9.0, "b": 9.0, "aZ": 1.1, "Z": 9.0}
    includes = {"Z": SimpleNamespace(includes=("b",))}
    asked = fake("ab", errors, monkeypatch, rivals={"b": "Z"}, effects=includes)
    assert reviewing.prune_model(*asked)[0].names == "ab"
    for more, error in ((includes, 0.9), ({}, 1.1)):
        errors["aZ"] = error
        asked = fake("ab", errors, monkeypatch, rivals={"b": "Z"}, effects=more)
        assert reviewing.prune_model(*asked)[0].names == "aZ"


def test_what_does_no_more_than_a_simpler_one_gives_way_above_the_floor(monkeypatch):
    """Two poles of 130 Hz and 17 kHz came to 0.84 where the pole had 1.0: a dark current was missing."""
    errors = {"Z": 1.4, "": 9.0, "b": 1.35 + DEFAULTS.grades.includer_better}
    for simpler, left in (({"Z": "b"}, "b"), ({}, "Z")):
        asked = fake("Z", errors, monkeypatch, rivals={"Z": "b"}, simpler=simpler)
        assert reviewing.prune_model(*asked)[0].names == left
    errors["b"] = 1.45 + DEFAULTS.grades.includer_better  # two poles
    asked = fake("Z", errors, monkeypatch, rivals={"Z": "b"}, simpler={"Z": "b"})
    assert reviewing.prune_model(*asked)[0].names == "Z"


def test_no_rival_takes_the_place_of_what_a_closer_look_shows(monkeypatch):
    errors = {"aZ": 0.3, "Z": 9.0, "a": 9.0, "ab": 0.4, "b": 9.0}
    asked = fake("aZ", errors, monkeypatch, rivals={"Z": "b"})
    monkeypatch.setattr(reviewing, "lacks_effect_of", lambda task, less, without, m: less.names == "ab")
    assert reviewing.prune_model(*asked)[0].names == "aZ"
