"""What an effect between the scene and the pixels is to dase: it changes what the pixels see."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from dase.effects.base import Effect
from dase.scenes.scene import Scene


@dataclass(frozen=True, kw_only=True)
class SceneEffect(Effect):
    """A physical effect of the light before it falls on single pixels, where neighbours matter.

    Its stages are empty; `seen` wraps the scene. Its parameters have no place in a parameter vector, for all
    rows of a batch see the same.
    """

    stages: ClassVar = {}

    @abstractmethod
    def seen(self, scene: Scene) -> Scene:
        """Return what the pixels see of `scene`; the scene itself where the effect is off."""
