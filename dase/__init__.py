"""A learned, physical event-camera simulator."""

from importlib.metadata import version as _version

from dase.config import dump_sensor as dump_sensor
from dase.config import load_sensor as load_sensor
from dase.effects import EFFECTS as EFFECTS
from dase.effects import Effect as Effect
from dase.errors import InputError as InputError
from dase.events import Events as Events
from dase.images import Picture as Picture
from dase.images import open_images as open_images
from dase.layers import Layer as Layer
from dase.layers import LayerScene as LayerScene
from dase.layers import Motion as Motion
from dase.scene import Scene as Scene
from dase.sensor import Sensor as Sensor
from dase.sensor import count as count
from dase.sensor import simulate as simulate
from dase.sensor import stream as stream
from dase.video import VideoScene as VideoScene

__version__ = _version("dase")
