"""What the tests of gradients of layered scenes share: the fields of a place, the sizes of textures."""

from __future__ import annotations

FIELDS = ("x", "y", "angle", "scale_x", "scale_y")


def sizes_of(textures):
    return [tuple(grey.shape) for grey, _ in textures]
