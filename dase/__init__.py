"""A learned, physical event-camera simulator."""

from difflib import get_close_matches
from importlib import import_module
from typing import TYPE_CHECKING, Any

from dase.errors import how_to_install
from dase.version import __version__ as __version__

if TYPE_CHECKING:
    from dase.diagnosis.compare import compare as compare
    from dase.diagnosis.diagnose import diagnose as diagnose
    from dase.effects import EFFECTS as EFFECTS
    from dase.effects import Effect as Effect
    from dase.errors import InputError as InputError
    from dase.events import Events as Events
    from dase.figures.plot import plot as plot
    from dase.fitting.fit import fit as fit
    from dase.recordings.recording import Recording as Recording
    from dase.recordings.recording import open_recording as open_recording
    from dase.representations import AveragedTimeSurface as AveragedTimeSurface
    from dase.representations import CountImage as CountImage
    from dase.representations import EventFrame as EventFrame
    from dase.representations import StackedHistogram as StackedHistogram
    from dase.representations import TimeSurface as TimeSurface
    from dase.representations import Voxels as Voxels
    from dase.scenes.between_frames import CameraScene as CameraScene
    from dase.scenes.frame_alignment import align as align
    from dase.scenes.image_sources import Picture as Picture
    from dase.scenes.image_sources import open_images as open_images
    from dase.scenes.layers import Layer as Layer
    from dase.scenes.layers import LayerScene as LayerScene
    from dase.scenes.layers import Lighting as Lighting
    from dase.scenes.layers import Motion as Motion
    from dase.scenes.layers import Wave as Wave
    from dase.scenes.scene import Scene as Scene
    from dase.scenes.screen_scene import open_stimulus as open_stimulus
    from dase.scenes.static import StaticScene as StaticScene
    from dase.scenes.video import VideoScene as VideoScene
    from dase.scenes.video import open_video as open_video
    from dase.signatures.find import find_signatures as find_signatures
    from dase.simulation.sensor import Sensor as Sensor
    from dase.simulation.sensor_file import dump_sensor as dump_sensor
    from dase.simulation.sensor_file import load_sensor as load_sensor
    from dase.simulation.simulate import count as count
    from dase.simulation.simulate import simulate as simulate
    from dase.simulation.simulate import stream as stream
    from dase.simulation.sweep import sweep as sweep
    from dase.simulation.user_effects import load_effects as load_effects


_HOMES = {
    "dase.scenes.frame_alignment": ("align",),
    "dase.scenes.between_frames": ("CameraScene",),
    "dase.diagnosis.compare": ("compare",),
    "dase.simulation.sensor_file": ("dump_sensor", "load_sensor"),
    "dase.diagnosis.diagnose": ("diagnose",),
    "dase.simulation.user_effects": ("load_effects",),
    "dase.effects": ("EFFECTS", "Effect"),
    "dase.errors": ("InputError",),
    "dase.events": ("Events",),
    "dase.figures.plot": ("plot",),
    "dase.fitting.fit": ("fit",),
    "dase.representations": (
        "AveragedTimeSurface",
        "CountImage",
        "EventFrame",
        "StackedHistogram",
        "TimeSurface",
        "Voxels",
    ),
    "dase.scenes.image_sources": ("Picture", "open_images"),
    "dase.scenes.layers": ("Layer", "LayerScene", "Lighting", "Motion", "Wave"),
    "dase.recordings.recording": ("Recording", "open_recording"),
    "dase.scenes.scene": ("Scene",),
    "dase.scenes.screen_scene": ("open_stimulus",),
    "dase.signatures.find": ("find_signatures",),
    "dase.simulation.sensor": ("Sensor",),
    "dase.simulation.simulate": ("count", "simulate", "stream"),
    "dase.simulation.sweep": ("sweep",),
    "dase.scenes.static": ("StaticScene",),
    "dase.scenes.video": ("VideoScene", "open_video"),
}
"""Module to the public names it is the home of; loaded when first used, so that `dase --help` is instant."""

_MODULE_OF = {name: module for module, names in _HOMES.items() for name in names}
__all__ = list(_MODULE_OF)


def __getattr__(name: str) -> Any:
    if name in ("io", "tasks", "torch"):  # packages; the last two need PyTorch
        try:
            return import_module(f"dase.{name}")
        except ModuleNotFoundError as error:
            if (error.name or "").split(".")[0] != "torch":
                raise
            raise ImportError(f"dase.{name} needs PyTorch: {how_to_install('learn')}") from None
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'dase' has no attribute '{name}'{_hint(name)}")
    return getattr(import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), "io", *__all__])


def _hint(name: str) -> str:
    """Return what somebody may have looked for who asked for a name that is not there."""
    files = {
        **dict.fromkeys(("load", "open", "read"), "dase.open_recording(path)"),
        **dict.fromkeys(("save", "write"), "dase.io.write(path, events)"),
        "convert": "dase.io.convert(source, target)",
        "show": "dase.plot(what)",
        "presets": "dase.load_sensor(name)",
        "signatures": "dase.find_signatures(recording)",
    }
    near = get_close_matches(name, __all__, 1)
    likely = files.get(name.lower()) or (f"dase.{near[0]}" if near else "")
    return f"; {likely} may be meant" if likely else ""
