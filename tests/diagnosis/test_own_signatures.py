"""A signature names an effect of the user's own that says it makes it."""

from __future__ import annotations

import pytest
from helpers.own_effects import effect_that_makes

from dase.diagnosis.seen_effects import SeenEffects
from dase.effects import EFFECTS, Makes
from dase.results import Finding, Grade
from dase.signatures.kinds import KINDS
from dase.signatures.result import Answer, Signature

TELLING = sorted(
    {one.signature for e in EFFECTS.values() for one in e.signatures if one.tells and not one.by}
)


def entry_of(name: str, answer: Answer = Answer.FOUND) -> Signature:
    return Signature(name=name, answer=answer, sentence="seen")


def own_beside(*others: str, makes: tuple[Makes, ...] | None) -> dict:
    return {name: EFFECTS[name] for name in others} | {"own": effect_that_makes("own", makes)}


@pytest.mark.parametrize("name", TELLING)
def test_it_is_certain_where_no_other_makes_it(name):
    library = own_beside("threshold", "bandwidth", makes=(Makes(name, tells=True),))
    seen = SeenEffects((entry_of(name),), library=library)
    assert seen.effects == {"own": "seen"}
    assert seen.shown_whatever_fits == ({"own"} if KINDS[name].whatever_fits else set())
    (said,) = seen.findings([], ())
    assert (said.effect, said.grade, said.seen) == ("own", Grade.CERTAIN, "seen")


@pytest.mark.parametrize("name", TELLING)
def test_it_is_either_where_one_of_dase_makes_it_too(name):
    seen = SeenEffects((entry_of(name),), library=EFFECTS | own_beside(makes=(Makes(name, tells=True),)))
    assert seen.effects == {}
    (said,) = seen.findings([], ())
    assert (said.grade, said.alternatives, said.unknown) == (Grade.EITHER, ("own",), False)
    assert said.effect in EFFECTS
    # what the search came nearest with is named first, and what it announced stays
    (said,) = seen.findings([Finding("own", Grade.STAND_IN, error_with=1.0)], ())
    assert (said.effect, said.grade, said.error_with) == ("own", Grade.EITHER, 1.0)
    sure = Finding("own", Grade.SUPPORTED)
    assert seen.findings([sure], ()) == [sure]


@pytest.mark.parametrize("name", TELLING)
def test_one_that_says_it_makes_something_else_does_not_matter(name):
    other = "grouping"
    plain = SeenEffects((entry_of(name),))
    beside = SeenEffects((entry_of(name),), library=EFFECTS | own_beside(makes=(Makes(other),)))
    assert beside.effects == plain.effects
    assert len(plain.effects) == 1


@pytest.mark.parametrize("name", KINDS)
def test_one_that_does_not_say_may_make_what_is_seen_beside_a_model(name):
    seen = SeenEffects((entry_of(name),), library=EFFECTS | own_beside(makes=None))
    assert seen.may_name(name) is not KINDS[name].beside_model


def test_what_it_explains_is_not_said_again():
    entry, sure = entry_of("fixed pattern"), Finding("own", Grade.SUPPORTED)
    of_two, of_one = ["own"], ["own", "mismatch", "fixed pattern"]
    for makes, said in (((Makes("fixed pattern"),), of_two), ((), of_one)):
        seen = SeenEffects((entry,), library=EFFECTS | own_beside(makes=makes))
        assert [one.effect for one in seen.findings([sure], ())] == said
        given = [one.effect for one in seen.findings([], ("own",))]
        assert given == said[1:]


def test_the_few_that_make_a_pattern_are_offered():
    entry = entry_of("fixed pattern")
    offered, certain = SeenEffects((entry,)).findings([], ())
    assert (offered.effect, offered.grade, offered.unknown) == ("mismatch", Grade.EITHER, True)
    assert (certain.effect, certain.grade) == ("fixed pattern", Grade.CERTAIN)
    # of two it is one, of three nothing tells which, and what is offered already is not offered twice
    two = EFFECTS | own_beside(makes=(Makes("fixed pattern"),))
    offered, certain = SeenEffects((entry,), library=two).findings([], ())
    assert {offered.effect, *offered.alternatives} == {"mismatch", "own"}
    assert (offered.grade, offered.unknown, certain.effect) == (Grade.EITHER, True, "fixed pattern")
    three = two | {"other": own_beside(makes=(Makes("fixed pattern"),))["own"]}
    assert [one.effect for one in SeenEffects((entry,), library=three).findings([], ())] == ["fixed pattern"]
    rows = SeenEffects((entry_of("grouping"),)).findings([], ())
    assert {rows[0].effect, *rows[0].alternatives} == {"readout", "row_scan"}
    assert (rows[0].grade, rows[1].effect, rows[1].grade) == (Grade.EITHER, "grouping", Grade.CERTAIN)
    beside = Finding("jitter", Grade.EITHER, ("mismatch",))
    assert SeenEffects((entry,)).findings([beside], ())[:-1] == [beside]


def test_its_noise_may_come_in_either_way():
    entry = Signature(name="noise at rest", answer=Answer.FOUND, details={"independent": 0.5})
    seen = SeenEffects((entry,), library=own_beside("voltage_noise", makes=(Makes("noise at rest"),)))
    found = [Finding("own", Grade.SUPPORTED), Finding("voltage_noise", Grade.SUPPORTED)]
    grades = {one.effect: one.grade for one in seen.findings(found, ())}
    assert grades == {"own": Grade.SUPPORTED, "voltage_noise": Grade.EITHER}


def test_what_is_not_seen_says_that_it_would_have_been():
    absent = tuple(entry_of(name, Answer.NOT_SEEN) for name in ("time stamps", "hot pixels", "grouping"))
    assert [one.effect for one in SeenEffects(absent=absent).limits(())] == ["timestamp", "hot"]
    makes = (Makes("hot pixels", tells=True), Makes("time stamps", tells=True, absence=False))
    seen = SeenEffects(absent=absent, library=own_beside(makes=makes))
    assert [(one.effect, one.sentence) for one in seen.limits(())] == [("own", "hot pixels: seen")]
    assert seen.limits({"own"}) == ()
    # and whoever makes hot pixels is in doubt where none stands out
    (said,) = seen.findings([Finding("own", Grade.SUPPORTED)], ())
    assert (said.grade, said.unknown) == (Grade.EITHER, True)
