"""What can be counted of the code stays within its limits."""

from __future__ import annotations

import ast

import pytest
from helpers.scripts import ROOT, load_script

metrics = load_script("perf/code_metrics.py")


@pytest.fixture(scope="module")
def total():
    return metrics.measure(ROOT)["total"]


def test_few_names_stand_for_a_number_that_one_function_could_hold(total):
    assert 1000 * total.number("constants") / sum(total.files) < 6


def test_functions_say_what_they_do_to_what(total):
    assert total.number("one_word") / total.module_functions < 0.25


def test_every_array_has_its_shape_or_unit(total):
    assert total.arrays_described == total.arrays


@pytest.mark.parametrize("pattern", metrics.HARD_FILES)
def test_hard_files_say_why(pattern):
    for path in ROOT.glob(pattern):
        text = path.read_text("utf-8")
        code, comments = metrics.count_lines(text, ast.parse(text))
        assert comments >= 0.08 * code, path.name
