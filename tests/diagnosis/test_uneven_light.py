"""Vignetting beside what stood in for it: a current for the mean light, and pixels that differ by chance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.frame_simulator import HEIGHT, WIDTH, counted_between_frames, shaken_texture

from dase.diagnosis.candidates import calibrate_split, screen_and_descend
from dase.effects.bandwidth import Bandwidth
from dase.effects.dark import Dark
from dase.effects.mismatch import Mismatch
from dase.effects.row_scan import RowScan
from dase.effects.threshold import Threshold
from dase.effects.vignetting import Vignetting
from dase.fitting.data_split import split_measurement
from dase.fitting.measurement import as_measurement
from dase.fitting.model import (
    model_of,
    places_in_uneven_light,
    refit_model,
    starting_places,
    with_effect_added,
)
from dase.scenes.video import VideoScene
from dase.simulation.sensor import Sensor


def light_at(loss, width=WIDTH, height=HEIGHT):
    """Return the share of the light by the cos⁴ law, and the square distance from the middle, (H, W) each."""
    y, x = np.mgrid[:height, :width].astype(float)
    square = (x - (width - 1) / 2) ** 2 + (y - (height - 1) / 2) ** 2
    square /= square.max()
    return np.cos(np.arctan(np.sqrt(((1 - loss) ** -0.5 - 1) * square))) ** 4, square


LINE = 4e-6
"""Time from row to row of a scan [s]."""


@pytest.mark.parametrize("loss", [0.65, pytest.param(0.0, marks=pytest.mark.slow)])
def test_it_is_found_beside_what_stood_in_for_it(loss):
    """Events of another simulator with a dark current, behind a scan: a search follows a single start."""
    scene = shaken_texture()
    times = scene.sample_times()
    # no photocurrent there is below 20 greys, where that simulator is linear
    current = scene.frames(times) * light_at(loss)[0] + 0.08
    made = counted_between_frames(VideoScene(current.astype(np.float32), times), 0.0)
    turn = np.ceil(made.t / (LINE * HEIGHT) - made.y / HEIGHT)
    read = replace(made, t=(turn + made.y / HEIGHT) * LINE * HEIGHT)
    events = read.select(np.argsort(read.t, kind="stable"))
    evidence = split_measurement(as_measurement(events, scene), pixels=500, seed=0)
    scan = RowScan(line=LINE, keeps="all")
    begin = model_of(Sensor((Threshold(on=0.2, off=0.2), Dark(current=0.1, spread=0.2), scan)))
    present = refit_model(evidence, begin, seed=0, rounds=1)
    split = calibrate_split(evidence, present, repeats=12, scout_repeats=12, seed=0)
    found = screen_and_descend(split, present, Vignetting(), seed=0)
    if loss == 0.0:
        assert found.model.sensor["vignetting"].loss < 0.15
        assert found.model.sensor["dark"].current == pytest.approx(0.08, rel=0.1)
    else:
        assert present.sensor["dark"].current > 1.2 * 0.08
        # 0.71 to 0.83 with six seeds on a CPU without wide vectors, whose rounding sends a descent other ways
        assert found.screened_loss < 0.9
        assert found.model.sensor["vignetting"].loss == pytest.approx(loss, abs=0.1)
        assert found.model.sensor["dark"].current == pytest.approx(0.08, rel=0.2)


def test_a_search_begins_with_the_intensities_and_the_differences_that_are_left():
    sensor = Sensor((Dark(current=0.15, spread=0.2), Bandwidth(), Threshold(), Mismatch(spread=0.1)))
    effect = Vignetting()
    model = with_effect_added(model_of(sensor), effect)
    starts = starting_places(model, effect)
    made = [model.space.at(place) for place in places_in_uneven_light(model, effect, starts)]
    assert len(made) == 2 * len(starts)
    for sensor_there in made:
        shares = Vignetting(loss=sensor_there["vignetting"].loss).light_left()
        assert any(sensor_there["dark"].current == pytest.approx(0.15 * one, rel=1e-6) for one in shares)
        assert sensor_there["dark"].spread == pytest.approx(0.0, abs=1e-9)
        assert sensor_there["mismatch"].spread < 0.02
        assert sensor_there["bandwidth"].cutoff == pytest.approx(sensor["bandwidth"].cutoff)
    assert {round(one["vignetting"].loss, 9) for one in made} == {
        round(model.space.at(place)["vignetting"].loss, 9) for place in starts
    }


def test_it_begins_there_only_where_something_may_have_stood_in():
    for sensor, effect in ((Sensor(), Vignetting()), (Sensor((Dark(), Threshold())), Bandwidth())):
        model = with_effect_added(model_of(sensor), effect)
        starts = starting_places(model, effect)
        assert places_in_uneven_light(model, effect, starts).shape == (0, len(model.place))


@pytest.mark.parametrize(("width", "height"), [(72, 48), (64, 64), (200, 30)])
def test_the_light_that_is_left_is_that_of_all_pixels_and_of_the_outer_half(width, height):
    light, square = light_at(0.6, width, height)
    outer = square >= np.median(square)
    got = Vignetting(loss=0.6).light_left()
    np.testing.assert_allclose(got, [light.mean(), light[outer].mean()], rtol=0.06)
    assert Vignetting(loss=0.0).light_left() == (1.0, 1.0)
