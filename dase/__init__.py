"""A learned, physical event-camera simulator."""

from dase.errors import InputError as InputError
from dase.events import Events as Events
