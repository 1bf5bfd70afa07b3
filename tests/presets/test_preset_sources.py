"""Where the numbers of presets come from."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner
from helpers.scripts import load_script

import dase
from dase.cli.presets import presets_command
from dase.errors import InputError
from dase.simulation.preset_sources import preset_sources
from dase.simulation.sensor_file import load_sensor, read_presets

PRESETS = sorted(read_presets())


@pytest.mark.parametrize("name", PRESETS)
def test_every_number_of_a_preset_is_there_with_its_unit_and_source(name):
    """All that the sensor has is listed as the file says it; a number without a word of its source is not."""
    found, sensor = preset_sources(name), load_sensor(name)
    listed = {one.name: one for one in found.values}
    for effect in sensor.effects:
        for parameter in effect.parameters():
            value = getattr(effect, parameter.name)
            if value == parameter.default and f"{effect.name}.{parameter.name}" not in listed:
                continue
            one = listed[f"{effect.name}.{parameter.name}"]
            assert float(one.value) == pytest.approx(value, rel=1e-6)
            assert one.unit == ("" if parameter.unit == "1" else parameter.unit)
            assert one.source or one.value in ("0.0", "1.0"), f"{name}: {one.name} says no source"
    assert found.about


@pytest.mark.parametrize("name", PRESETS)
def test_no_preset_has_an_effect_twice(name):
    assert load_sensor(name).doubled_effects() == {}


def test_a_comment_on_lines_before_a_value_is_its_source():
    (period,) = (one for one in preset_sources("dvs128").values if one.name == "refractory.period")
    assert period.source.startswith("12 and 15 % of the intervals")


def test_the_page_is_that_of_the_files():
    page = (Path(dase.__file__).parents[1] / "docs" / "presets.md").read_text("utf-8")
    assert page == load_script("docs/presets.py").page(), "run python docs/presets.py"


def test_the_command_shows_values_and_knows_no_others():
    shown = CliRunner().invoke(presets_command, ["show", "davis346"])
    assert shown.exit_code == 0
    assert "bandwidth.cutoff   280.0 Hz" in shown.output
    listed = CliRunner().invoke(presets_command, ["list"])
    assert [line.split()[0] for line in listed.output.splitlines()] == PRESETS
    with pytest.raises(InputError, match="davis346"):
        preset_sources("davis345")
