"""What time stamps tell of a readout before any model is run."""

from __future__ import annotations

import pytest
from helpers.frame_simulator import shaken_texture

import dase
from dase.effects.row_scan import RowScan
from dase.effects.threshold import Threshold
from dase.fitting.data_split import split_measurement
from dase.fitting.measurement import Measurement


@pytest.mark.parametrize("keeps", ["first", "all"])
def test_stamps_tell_whether_a_pixel_of_a_scan_has_room_for_one_event(keeps):
    scene = shaken_texture()
    events = dase.simulate(scene, dase.Sensor((Threshold(on=0.1, off=0.1), RowScan(line=1e-4, keeps=keeps))))
    evidence = split_measurement(Measurement(events, scene), pixels=100)
    (seen,) = RowScan.candidates(evidence.observe(idle_bus=0.01))
    assert (seen.keeps, seen.direction) == (keeps, "down")
    assert seen.line == pytest.approx(1e-4, rel=1e-3)
