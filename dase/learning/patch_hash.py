"""Structure of patches, and the hash that sends patches of like structure to the same critic."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, get_args

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from dase.errors import InputError, nearest
from dase.kernels import launch
from dase.kernels import patch_structure as kernels

ContrastFrom = Literal["events", "energy"]


@dataclass(frozen=True, eq=False, kw_only=True)
class PatchAttributes:
    """What `attributes` found: float32 arrays of shape (B, rows, columns), one value per patch.

    Gradients are central differences. Means over a patch have Gaussian weights about its centre, of sigma =
    size/4 [pixel] and sum 1. λ1 >= λ2 are the eigenvalues of the mean of [gx gy]ᵀ[gx gy] (Romano et al.,
    RAISR: Rapid and Accurate Image Super Resolution, 2017).
    """

    angle: NDArray[np.float32]
    """Direction of the strongest gradient, across the edge [rad], in [0, π): 0 is along x, π/2 along y."""
    coherence: NDArray[np.float32]
    """(√λ1 - √λ2)/(√λ1 + √λ2): 1 for stripes, 0 for isotropic and for flat patches."""
    strength: NDArray[np.float32]
    """√λ1 [intensity/pixel]."""
    energy: NDArray[np.float32]
    """Mean of gx² + gy² = λ1 + λ2 [intensity²/pixel²]."""
    contrast: NDArray[np.float32]
    """Contrast of the event counts, Eq. 12 of the paper [events]; no window."""


def attributes(
    image: ArrayLike | wp.array,
    counts: ArrayLike | wp.array,
    *,
    size: int = 40,
    stride: int | None = None,
    device: str = "cpu",
) -> PatchAttributes:
    """Measure the structure of every patch.

    The contrast of Eq. 12 sums g²·P(g) over ordered pairs of 4-neighbours inside the patch, where g is their
    difference in events (all channels added up) and P its density in the patch, from 16 bins of width 1, the
    last open. Because P rewards differences that are common, a sharp edge beats the same events spread over a
    wide band, yet the same events scattered as single pixels beat the edge.

    A `wp.array` is read where it lies, without a copy: it must be on `device`, `image` float32 and `counts`
    int32 or float32. Anything else becomes a NumPy array. Patches that would stick out are left out.

    Args:
        image: Intensity aligned with the counts, shape (B, H, W).
        counts: Events per pixel, shape (B, C, H, W): usually OFF and ON.
        size: Side of a patch [pixel].
        stride: Step from patch to patch [pixel]; by default `size`.
        device: Warp device to work on.

    Raises:
        InputError: Shapes, dtypes or devices do not fit, a patch is too small or too large, or sees NaN.
    """
    where = _device(device)
    image = _as_array(image, "image", "(B, H, W)", where, (wp.float32,))
    counts = _as_array(counts, "counts", "(B, C, H, W)", where, (wp.float32, wp.int32))
    batch, height, width = image.shape
    if (batch, height, width) != (counts.shape[0], *counts.shape[2:]):
        raise InputError(f"counts: shape (B, C, H, W) must match image {image.shape}, got {counts.shape}")
    stride = size if stride is None else stride
    _check_patch(size, stride, height, width)
    rows, columns = (height - size) // stride + 1, (width - size) // stride + 1
    names = [field.name for field in fields(PatchAttributes)]
    out = {name: wp.empty((batch, rows * columns), dtype=wp.float32, device=where) for name in names}
    weight = wp.array(_window(size), dtype=wp.float32, device=where)
    structure = [out[name] for name in ("angle", "coherence", "strength", "energy")]
    over = {"size": rows * columns, "device": where, "batch": batch}
    sums = wp.empty((batch, rows * columns * size), dtype=wp.vec3, device=where)
    launch.run_kernel(
        kernels.structure_rows, sums.shape[1], [image, weight, stride, columns, sums], where, batch=batch
    )
    launch.run_kernel(kernels.structure_of_patches, inputs=[sums, weight, *structure], **over)
    contrast = kernels.contrast_kernels[counts.dtype]
    launch.run_kernel(contrast, inputs=[counts, size, stride, columns, out["contrast"]], **over)
    found = PatchAttributes(**{name: out[name].numpy().reshape(batch, rows, columns) for name in names})
    _check_finite(found.energy, "image")
    _check_finite(found.contrast, "counts")
    return found


@dataclass(frozen=True, kw_only=True)
class StructureHash:
    """Map of patches to buckets by orientation, coherence and contrast.

    Bins of orientation are centred on multiples of π/orientations, so that edges along the pixel grid do not
    fall between two bins. A level is the number of boundaries below the value. To leave an attribute out,
    give one orientation or no boundaries.

    `contrast_from="events"` is the hash of the paper. Beware: event counts depend on the thresholds being
    learned, so a change of thresholds moves patches from one bucket to another, comparing inside buckets
    misleads, and training can settle on wrong thresholds. Image energy does not have this fault.
    """

    orientations: int = 24
    """Number of bins of angle, over π."""
    coherence: tuple[float, ...]
    """Boundaries between levels of coherence, ascending."""
    contrast: tuple[float, ...]
    """Boundaries between levels of contrast, ascending [events, or intensity²/pixel²]."""
    contrast_from: ContrastFrom = "energy"
    """What contrast is: `energy` of the image gradient, or `events`, Eq. 12 of the paper."""

    def __post_init__(self) -> None:
        if not _is_integer(self.orientations) or self.orientations < 1:
            raise InputError(f"StructureHash.orientations must be an integer >= 1, got {self.orientations!r}")
        if self.contrast_from not in get_args(ContrastFrom):
            raise InputError(
                f"StructureHash.contrast_from must be 'events' or 'energy', got {self.contrast_from!r}"
            )
        for name in ("coherence", "contrast"):
            object.__setattr__(self, name, _boundaries(name, getattr(self, name)))

    @property
    def buckets(self) -> int:
        """Number of buckets: 216 for 24 orientations and two boundaries each."""
        return self.orientations * (len(self.coherence) + 1) * (len(self.contrast) + 1)

    @classmethod
    def calibrate(
        cls,
        *sets: PatchAttributes,
        orientations: int = 24,
        coherence_levels: int = 3,
        contrast_levels: int = 3,
        contrast_from: ContrastFrom = "energy",
    ) -> StructureHash:
        """Place boundaries at quantiles, so that levels hold equal shares of the patches of all `sets`.

        Args:
            sets: Attributes of the calibration patches, of any shapes.
            orientations: Number of bins of angle.
            coherence_levels: Three for terciles, one to leave coherence out.
            contrast_levels: Three for terciles, one to leave contrast out.
            contrast_from: See `StructureHash`.

        Raises:
            InputError: There is not one patch, or a number of levels is below one.
        """
        empty = cls(orientations=orientations, coherence=(), contrast=(), contrast_from=contrast_from)
        return cls(
            orientations=orientations,
            coherence=_quantiles([s.coherence for s in sets], "coherence_levels", coherence_levels),
            contrast=_quantiles([empty._contrast(s) for s in sets], "contrast_levels", contrast_levels),
            contrast_from=contrast_from,
        )

    def bucket(self, attributes: PatchAttributes) -> NDArray[np.int32]:
        """Return the bucket of every patch, in 0..buckets - 1 and of the shape of the attributes.

        With three levels each: (3·orientation + coherence)·3 + contrast.
        """
        orientation = np.floor(attributes.angle.astype(np.float64) * (self.orientations / np.pi) + 0.5)
        coherence = np.searchsorted(self.coherence, attributes.coherence)
        contrast = np.searchsorted(self.contrast, self._contrast(attributes))
        index = orientation.astype(np.int32) % self.orientations
        index = index * (len(self.coherence) + 1) + coherence
        return (index * (len(self.contrast) + 1) + contrast).astype(np.int32)

    def to_dict(self) -> dict[str, Any]:
        """Return numbers, strings and lists that TOML and JSON can store."""
        return {
            key: list(value) if isinstance(value, tuple) else value for key, value in asdict(self).items()
        }

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> StructureHash:
        """Return the hash that `to_dict` stored; raises InputError for keys unknown or missing."""
        known = [field.name for field in fields(cls)]
        for key in stored:
            if key not in known:
                raise InputError(f"StructureHash: unknown key '{key}'; {nearest(key, known)}")
        for key in ("coherence", "contrast"):
            if key not in stored:
                raise InputError(f"StructureHash: key '{key}' is missing, it lists the boundaries of {key}")
        return cls(**stored)

    def _contrast(self, attributes: PatchAttributes) -> NDArray[np.float32]:
        return attributes.contrast if self.contrast_from == "events" else attributes.energy


def _is_integer(value: object) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def _boundaries(name: str, values: object) -> tuple[float, ...]:
    try:
        found = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        found = np.full((), np.nan)
    if found.ndim != 1 or not np.isfinite(found).all() or (np.diff(found) < 0).any():
        raise InputError(f"StructureHash.{name} must list finite numbers in ascending order, got {values!r}")
    return tuple(found.tolist())


def _quantiles(values: list[NDArray[np.float32]], name: str, levels: int) -> tuple[float, ...]:
    if not _is_integer(levels) or levels < 1:
        raise InputError(f"StructureHash.calibrate: {name} must be an integer >= 1, got {levels!r}")
    if not sum(part.size for part in values):
        raise InputError("StructureHash.calibrate: needs at least one patch, got none")
    pooled = np.concatenate([part.ravel() for part in values]).astype(np.float64)
    return tuple(np.quantile(pooled, np.arange(1, levels) / levels).tolist())


def _device(name: str) -> Any:
    try:
        return launch.find_device(name)
    except ValueError as error:
        raise InputError(str(error)) from error


def _as_array(values: Any, name: str, shape: str, device: Any, dtypes: tuple[Any, ...]) -> Any:
    """Return `values` as a Warp array of one of `dtypes`, the first for floats and the last for integers."""
    if isinstance(values, wp.array):
        if values.dtype not in dtypes:
            names = " or ".join(dtype.__name__ for dtype in dtypes)
            raise InputError(f"{name}: dtype must be {names}, got {wp.types.type_repr(values.dtype)}")
        if values.device != device:
            raise InputError(f"{name}: array must be on the device asked for, {device}, got {values.device}")
        found = values
    else:
        try:
            raw = np.asarray(values)
        except ValueError as error:
            raise InputError(f"{name}: must be an array of shape {shape}, {error}") from error
        if raw.dtype.kind not in "iubf":
            raise InputError(f"{name}: must be real numbers, got dtype {raw.dtype}")
        dtype = dtypes[0] if raw.dtype.kind == "f" else dtypes[-1]
        with np.errstate(over="ignore"):  # infinity is refused later, with its place
            raw = np.require(raw, wp.dtype_to_numpy(dtype), "C")
        found = wp.array(raw, dtype=dtype, device=device, copy=False)
    if found.ndim != shape.count(",") + 1 or 0 in found.shape:
        raise InputError(f"{name}: shape must be {shape} with nothing empty, got {found.shape}")
    return found


def _check_patch(size: int, stride: int, height: int, width: int) -> None:
    if not _is_integer(size) or size < 4:
        raise InputError(f"size: a patch must be an integer >= 4 pixels wide, got {size!r}")
    if not _is_integer(stride) or stride < 1:
        raise InputError(f"stride: must be an integer >= 1 pixel, got {stride!r}")
    if size > min(height, width):
        raise InputError(f"size: a patch must fit into the map of {width}x{height} pixels, got {size}")


def _check_finite(values: NDArray[np.float32], name: str) -> None:
    """Refuse what the kernels made of NaN: they carry it through, and no pass over the maps is needed."""
    wrong = np.argwhere(~np.isfinite(values))
    if len(wrong):
        b, row, column = wrong[0].tolist()
        raise InputError(
            f"{name}: pixels must be finite, got NaN or infinity in patch ({row}, {column}) of map {b}"
        )


def _window(size: int) -> NDArray[np.float64]:
    """Gaussian weights along one axis of a patch, sigma = size/4, sum 1."""
    weight = np.exp(-0.5 * ((np.arange(size) - (size - 1) / 2) / (size / 4)) ** 2)
    return np.asarray(weight / weight.sum())
