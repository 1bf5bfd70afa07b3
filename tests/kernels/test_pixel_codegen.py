"""Statements of kernels: what they say about themselves, and what layouts make of it."""

from __future__ import annotations

import pytest
import warp as wp

from dase.effects import EFFECTS
from dase.kernels import pixel_codegen_trials, pixel_compile
from dase.kernels.pixel_codegen import (
    Block,
    Draw,
    Guarded,
    Line,
    Part,
    draws_of,
    if_block,
    lines,
    names_needed,
    names_written,
    print_statements,
    resolve_guards,
)
from dase.kernels.pixel_codegen_cpu import Lanes
from dase.kernels.pixel_codegen_cuda import OnePixel
from dase.kernels.pixel_codegen_model import call_stage
from dase.kernels.pixel_stages import EffectStages

FADES = EffectStages("fades", (), ("share",), off=(("share", 0.0),))
STAYS = EffectStages("stays", ())
KINDS = {"light": "Floats", "dose": "Floats"}


def test_a_line_knows_its_names():
    line = Line("dose, rest = add(light, dose)")
    assert line.names == ("dose", "rest", "add", "light")
    assert line.writes == {"dose", "rest"}
    assert line.reads == {"add", "light", "dose"}
    assert Line("dose += light").reads == {"dose", "light"}
    assert Line("out[row, i] = dose").writes == set()


def test_what_is_set_whatever_happens_is_not_needed():
    assert names_needed(lines("dose = light", "rest = dose")) == {"dose": False, "light": True, "rest": False}
    # where the condition does not hold the old value stays
    block = if_block("light > 0.0", "dose = light")
    assert names_needed((block,)) == {"light": True, "dose": True}
    assert names_written((block, Line("rest = 1.0"))) == {"dose", "rest"}


def test_draws_come_once_in_the_order_of_the_text():
    first, second = Draw("a", "uniform"), Draw("b", "normal", per_pixel=True)
    inner = Block("if x:", (Line("y = 1.0", (second,)), Line("z = 1.0", (first,))), draws=(first,))
    assert draws_of((inner, Line("w = b", (second,)))) == (first, second)


def test_guards_are_asked_for_where_an_effect_may_be_off():
    body = lines("light = 0.5 * light")
    both = (Guarded(FADES, body), Guarded(STAYS, body))
    assert print_statements(resolve_guards(both, ask=False)) == ["light = 0.5 * light"] * 2
    asked = ["if fades_acts != 0:", "    light = 0.5 * light", "light = 0.5 * light"]
    assert print_statements(resolve_guards(both, ask=True)) == asked


def test_one_pixel_does_a_part_as_it_stands():
    part = Part(lines("dose = light"), when=("sample == 0", "phase != 0.0"), then=lines("dt = 0.0"))
    want = ["if sample == 0 and phase != 0.0:", "    dose = light", "    dt = 0.0"]
    assert print_statements(OnePixel().lay_out(part)) == want


def test_lanes_move_what_a_part_needs_and_changes():
    part = Part(lines("dose = 2.0 * light"), when=("sample == 0",), then=lines("dt = 0.0"))
    assert print_statements(Lanes(4, KINDS).lay_out(part)) == [
        "if sample == 0:",
        "    for each in range(4):",
        "        lane = within(each, 4)",
        "        i = start + lane",
        "        light = light_lanes[lane]",
        "        dose = 2.0 * light",
        "        dose_lanes[lane] = dose",
        "    dt = 0.0",
    ]


def test_a_condition_that_differs_from_lane_to_lane_is_left_out():
    part = Part(lines("dose += light"), when=("sample == 1", "dose != 0.0"))
    assert print_statements(Lanes(4, KINDS).lay_out(part))[0] == "if sample == 1:"
    alone = Part(lines("dose += light"), when=("dose != 0.0",))
    assert print_statements(Lanes(4, KINDS).lay_out(alone))[0] == "for each in range(4):"


def test_lanes_skip_what_no_model_has():
    part = Part((Line("dose = light"), Guarded(FADES, lines("dose += light")), Line("light = 0.0")))
    text = print_statements(Lanes(4, KINDS, asks=True).lay_out(part))
    assert text.count("if fades_some != 0:") == 1
    assert sum(line.lstrip().startswith("for each") for line in text) == 3


def test_arguments_are_resolved_by_name():
    @wp.func
    def light(intensity: float, share: float, x: float, pixel_normal: float, uniform_2: float):
        return intensity * share * x * pixel_normal * uniform_2

    call = call_stage("light", FADES, light)
    want = "light_of_fades(intensity, fades_share, float(x), fades_light_pixel_normal, "
    assert call.text == want + "uniform(fades_light_uniform_2_key, sample))"
    assert [(draw.name, draw.kind, draw.per_pixel) for draw in call.draws] == [
        ("fades_light_pixel_normal", "normal", True),
        ("fades_light_uniform_2", "uniform", False),
    ]


@pytest.mark.parametrize("lanes", [0, 1, 16])
@pytest.mark.parametrize("sink", ["counts", "keys", "labels"])
@pytest.mark.parametrize("source", ["frames", "layers", "background"])
def test_texts_are_python(source, sink, lanes):
    stages = tuple(effect().compiled() for effect in EFFECTS.values())
    compile(pixel_compile.source_text(stages, source, sink, lanes=lanes), "kernel", "exec")
    compile(pixel_codegen_trials.source_text(stages, lanes=max(lanes, 1)), "kernel", "exec")
