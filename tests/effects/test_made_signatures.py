"""What effects say of the signatures that they make."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.own_effects import effect_that_makes

import dase
from dase.effects import EFFECTS, Makes
from dase.effects.made_signatures import made_by, makers_of, told_by
from dase.errors import InputError
from dase.signatures.kinds import KINDS
from dase.signatures.result import Answer, Signature


def seen(name: str, **details: float) -> Signature:
    return Signature(name=name, answer=Answer.FOUND, details=details)


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_of_dase_says_what_it_makes(name):
    made = EFFECTS[name].signatures
    assert made is not None
    assert {one.signature for one in made} <= KINDS.keys()
    assert len({one.signature for one in made}) == len(made)


@pytest.mark.parametrize("name", KINDS)
def test_every_signature_is_made_by_an_effect_of_dase(name):
    assert makers_of(name, EFFECTS)


@pytest.mark.parametrize("name", KINDS)
def test_a_signature_tells_of_one_effect_of_dase_at_most(name):
    """A diagnosis calls it certain."""
    assert len(told_by(seen(name), EFFECTS)) <= 1
    for way in KINDS[name].ways:
        assert len(told_by(seen(name, **{way: 1.0}), EFFECTS)) == 1


def test_signatures_of_events_alone_are_those_that_are_looked_for():
    events = dase.Events(
        t=np.arange(5) * 1e-3, x=np.arange(5), y=np.arange(5), p=np.ones(5, bool), width=8, height=8
    )
    looked_for = {entry.name for entry in dase.find_signatures(events).entries}
    assert looked_for == {kind.name for kind in KINDS.values() if not kind.beside_model}


def test_the_usual_one_comes_first_wherever_it_acts():
    """Noise of no certain way is said to be either: shot noise first, though it acts after the other."""
    assert list(makers_of("noise at rest", EFFECTS)) == ["shot", "voltage_noise"]
    assert list(makers_of("grouping", EFFECTS)) == [n for n in EFFECTS if made_by(EFFECTS[n], "grouping")]


def test_time_stamps_tell_by_what_they_have():
    assert told_by(seen("time stamps", step=1e-3), EFFECTS) == ("timestamp",)
    assert told_by(seen("time stamps", line=1e-5, period=1e-2), EFFECTS) == ("row_scan",)
    assert told_by(seen("time stamps", period=1e-2), EFFECTS) == ()


def test_an_effect_of_the_user_is_named_beside_those_of_dase():
    library = EFFECTS | {"warm": effect_that_makes("warm", (Makes("hot pixels", tells=True),))}
    assert told_by(seen("hot pixels"), library) == ("hot", "warm")
    assert told_by(seen("hot pixels"), {"warm": library["warm"]}) == ("warm",)
    assert made_by(effect_that_makes("other"), "hot pixels") is None


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (dict(signature="hot pixel"), "there is no signature 'hot pixel': .*hot pixels"),
        (dict(signature="flicker", tells=True, by="step"), "by must be empty, got 'step'"),
        (dict(signature="time stamps", tells=True, by="row"), "by must be one of step, line, got 'row'"),
        (dict(signature="time stamps", by="step"), "by = 'step' needs tells = True"),
    ],
)
def test_what_makes_no_sense_is_refused(given, message):
    with pytest.raises(InputError, match=message):
        Makes(**given)
