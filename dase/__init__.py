"""A learned, physical event-camera simulator."""

from importlib import import_module
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as _version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dase.alignment import align as align
    from dase.camera import CameraScene as CameraScene
    from dase.comparison import compare as compare
    from dase.config import dump_sensor as dump_sensor
    from dase.config import load_sensor as load_sensor
    from dase.diagnosis import diagnose as diagnose
    from dase.effect_files import load_effects as load_effects
    from dase.effects import EFFECTS as EFFECTS
    from dase.effects import Effect as Effect
    from dase.errors import InputError as InputError
    from dase.events import Events as Events
    from dase.fitting import fit as fit
    from dase.images import Picture as Picture
    from dase.images import open_images as open_images
    from dase.layers import Layer as Layer
    from dase.layers import LayerScene as LayerScene
    from dase.layers import Motion as Motion
    from dase.recording import Recording as Recording
    from dase.recording import open_recording as open_recording
    from dase.scene import Scene as Scene
    from dase.sensor import Sensor as Sensor
    from dase.sensor import count as count
    from dase.sensor import simulate as simulate
    from dase.sensor import stream as stream
    from dase.static import StaticScene as StaticScene
    from dase.video import VideoScene as VideoScene
    from dase.video import open_video as open_video

try:
    __version__ = _version("dase")
except PackageNotFoundError:  # a checkout on the path, not installed
    __version__ = "0+unknown"

_HOMES = {
    "dase.alignment": ("align",),
    "dase.camera": ("CameraScene",),
    "dase.comparison": ("compare",),
    "dase.config": ("dump_sensor", "load_sensor"),
    "dase.diagnosis": ("diagnose",),
    "dase.effect_files": ("load_effects",),
    "dase.effects": ("EFFECTS", "Effect"),
    "dase.errors": ("InputError",),
    "dase.events": ("Events",),
    "dase.fitting": ("fit",),
    "dase.images": ("Picture", "open_images"),
    "dase.layers": ("Layer", "LayerScene", "Motion"),
    "dase.recording": ("Recording", "open_recording"),
    "dase.scene": ("Scene",),
    "dase.sensor": ("Sensor", "count", "simulate", "stream"),
    "dase.static": ("StaticScene",),
    "dase.video": ("VideoScene", "open_video"),
}
"""Module to the public names it is the home of; loaded when first used, so that `dase --help` is instant."""

_MODULE_OF = {name: module for module, names in _HOMES.items() for name in names}
__all__ = list(_MODULE_OF)


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'dase' has no attribute '{name}'")
    return getattr(import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
