"""Events straight into PyTorch: endless labelled batches, made where the network is trained.

    for batch in dase.torch.Stream("builtin", "davis240c"):
        batch.inputs        # (T, B, C, H, W)

It needs PyTorch (extra `learn`), which `import dase` alone does not load.
"""

from __future__ import annotations

from dase.torch.batch import Batch as Batch
from dase.torch.recordings import Recordings as Recordings
from dase.torch.scene_numbers import S2R as S2R
from dase.torch.scene_numbers import Augment as Augment
from dase.torch.stream import Stream as Stream
