"""Ticks that are slower than those of any clock may be a readout of all pixels at once."""

from __future__ import annotations

import pytest

from dase.diagnosis.seen_effects import SeenEffects
from dase.effects import EFFECTS
from dase.results import Grade
from dase.signatures.kinds import TIME_STAMPS
from dase.signatures.result import Answer, Signature


def said_of(details, library=EFFECTS):
    entry = Signature(name=TIME_STAMPS, answer=Answer.FOUND, sentence="", details=details)
    found = SeenEffects((entry,), library=library).findings([], ())
    return [(one.effect, one.grade, one.alternatives, one.unknown) for one in found]


@pytest.mark.parametrize(("step", "slow"), [(5e-4, False), (3.1e-3, True)])
def test_a_slow_clock_may_be_a_scan_of_all_pixels_at_once(step, slow):
    expected = (Grade.EITHER, ("row_scan",)) if slow else (Grade.CERTAIN, ())
    assert said_of({"step": step}) == [("timestamp", *expected, False)]


def test_packets_rows_and_clocks_alone_stay_certain():
    assert said_of({"step": 3e-3, "packets": 900.0}) == [("timestamp", Grade.CERTAIN, (), False)]
    assert said_of({"line": 1e-5})[0][:2] == ("row_scan", Grade.CERTAIN)
    clocks = {"timestamp": EFFECTS["timestamp"]}
    assert said_of({"step": 3e-3}, clocks) == [("timestamp", Grade.CERTAIN, (), False)]
