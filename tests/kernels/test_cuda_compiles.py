"""CUDA code of the kernels compiles, also where there is no GPU to run it."""

from __future__ import annotations

import importlib

import pytest
import warp as wp

from dase.effects import EFFECTS
from dase.kernels import (
    critic_layers,
    critic_products,
    launch,
    pixel_codegen_scenes,
    pixel_codegen_trials,
    pixel_compile,
    scene_render,
    scene_windows,
    threshold_counts,
)
from dase.simulation.sensor import Sensor

ARCH = 90
"""Compute capability that is compiled for: H100 and H200."""

MODULES = (
    "critic_layers", "critic_products", "critic_rows", "event_groups", "event_keys", "event_neighbours",
    "event_order", "event_probes", "event_queue", "folded_rates", "patch_structure", "pixel_codegen_trials",
    "scene_batch", "scene_blur", "scene_frames", "scene_layers", "scene_layers_gradient", "scene_paths",
    "threshold_surrogates",
)  # fmt: skip
"""Those whose kernels are not made by functions."""


def every() -> Sensor:
    """Return a sensor with every effect on its pixels."""
    return Sensor(
        tuple(effect() for effect in EFFECTS.values() if effect.stages or effect.name == "threshold")
    )


def compiles(module: wp.Module, folder) -> None:
    launch.find_device("cpu")  # starts Warp
    wp.compile_aot_module(module, arch=ARCH, module_dir=folder)
    assert any(path.suffix in (".cubin", ".ptx") for path in folder.iterdir())


@pytest.mark.parametrize("name", MODULES)
def test_plain_kernels(name, tmp_path):
    importlib.import_module(f"dase.kernels.{name}")
    compiles(wp.get_module(f"dase.kernels.{name}"), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "sink"), [("frames", "counts"), ("layers", "labels"), ("background", "keys")]
)
def test_pixels_with_every_effect(source, sink, tmp_path):
    compiles(pixel_compile.compose_pixels(every().stages(), source, sink).module, tmp_path)


@pytest.mark.slow
def test_pixels_of_many_scenes(tmp_path):
    compiles(pixel_codegen_scenes.compose_scenes(every().stages(), "layers", "voxels").module, tmp_path)


@pytest.mark.parametrize("kernel", [scene_windows.flow_kernel, scene_windows.rendering_kernel])
def test_pictures_of_many_scenes(kernel, tmp_path):
    compiles(kernel(1).module, tmp_path)


def test_pixels_of_many_models(tmp_path):
    compiles(pixel_codegen_trials.compose_trials(every().stages()).module, tmp_path)


@pytest.mark.parametrize(("source", "lanes"), [("log", 4), ("frames", 4), ("background", 4), ("layers", 1)])
def test_counting(source, lanes, tmp_path):
    compiles(threshold_counts.counting_kernel(lanes, source, shared=False, states=True).module, tmp_path)
    if source in ("log", "frames"):
        compiles(
            threshold_counts.counting_kernel(lanes, source, shared=False, states=True, aligned=True).module,
            tmp_path,
        )


def test_pictures_of_layers(tmp_path):
    compiles(scene_render.rendering_kernel(1).module, tmp_path)
    compiles(scene_render.flow_kernel(1).module, tmp_path)


@pytest.mark.parametrize("half", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_critics(half, tmp_path):
    steps = [critic_products.step_kernels[half, belief] for belief in (False, True)]
    for kernel in (*steps, *vars(critic_layers.layer_kernels[half]).values()):
        compiles(kernel.module, tmp_path)
