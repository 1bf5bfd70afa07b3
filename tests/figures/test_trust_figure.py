"""Pictures of trust show what they should."""

from __future__ import annotations

import numpy as np
import pytest
from click.testing import CliRunner
from reference.scene_frames import film, moving_picture

import dase
from dase import io
from dase.figures import trust_figure
from dase.io.sequence import Sequence


@pytest.fixture(scope="module")
def seen():
    """A scene between frames, and events that a camera made of the truth."""
    rng = np.random.default_rng(8)
    truth = moving_picture(rng, width=96, height=72)
    begin, end, frames = film(truth, rng)
    frames[:, 5:12, 5:12] = 255
    return dase.CameraScene(frames, begin, end), dase.simulate(truth, dase.Sensor()), frames, begin, end


def test_a_panel_shows_events_doubt_and_the_unknown(seen):
    scene, events, *_ = seen
    time = 0.5 * (scene.times[1] + scene.times[2])
    picture = trust_figure.trust_picture(scene, events, time, 0.005).astype(float)
    assert picture.shape == (72 * 3, 96 * 3, 3)
    pixels = picture[1::3, 1::3]
    counts = events.counts([time - 0.0025, time + 0.0025])[0]
    on, off = (counts[1] > 0) & (counts[0] == 0), (counts[0] > 0) & (counts[1] == 0)
    assert min(on.sum(), off.sum()) > 20
    assert (pixels[on, 0] > pixels[on, 2] + 30).all()
    assert (pixels[off, 2] > pixels[off, 0] + 30).all()
    silent, doubt = counts.sum(0) == 0, scene.doubt([time])[0]
    yellow = pixels[..., 0] - pixels[..., 2]
    limit = scene.limit(1)
    assert yellow[silent & (doubt > 2 * limit) & (doubt < 5)].mean() > 30
    assert np.abs(yellow[silent & (doubt < 0.1 * limit)]).mean() < 3
    hatched = picture[6 * 3 : 11 * 3, 6 * 3 : 11 * 3, 0]
    assert len(np.unique(hatched)) >= 2  # lines over the white that is saturated


def test_a_sheet_is_drawn(seen, tmp_path):
    scene, events, *_ = seen
    figure = trust_figure.draw_trust(scene, events, title="a title", moments=3)
    assert len(figure.axes) == 3
    said = [text.get_text() for text in figure.texts]
    assert said[0] == "a title"
    share = f"{100 * scene.trusted().mean():.0f} % of pixels"
    assert any(text.startswith(share) for text in said)
    figure.savefig(tmp_path / "trust.png")
    with pytest.raises(dase.InputError, match="must have the size of the scene, 96x72, got 5x5"):
        trust_figure.draw_trust(scene, dase.Events.empty(5, 5))
    with pytest.raises(dase.InputError, match="moments and window must be > 0"):
        trust_figure.draw_trust(scene, events, moments=0)


def test_the_command_draws_it(seen, tmp_path):
    from dase.cli import dase_group

    _, events, frames, begin, end = seen
    known = {"frame_times": 0.5 * (begin + end), "frame_exposure": end - begin}
    io.write(tmp_path / "made.npz", Sequence(events, frames, **known))
    done = CliRunner().invoke(dase_group, ["show", str(tmp_path / "made.npz"), "--trust"])
    assert done.exit_code == 0, done.output
    assert "% of pixels and times trusted" in done.output
    assert "ms after the frames and correlate with them at 0." in done.output
    assert (tmp_path / "made.trust.png").stat().st_size > 10_000
    io.write(tmp_path / "bare.npz", Sequence(events))
    done = CliRunner().invoke(dase_group, ["show", str(tmp_path / "bare.npz"), "--trust"])
    with pytest.raises(dase.InputError, match="needs at least 2 frames with known times"):
        raise done.exception
