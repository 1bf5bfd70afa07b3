"""Networks that are trained on events: video reconstruction and optical flow, their metrics and trainings.

    network = dase.tasks.E2VidNet()
    dase.tasks.train_reconstruction(network, lambda first: dase.torch.Stream(first_batch=first), "run")

It needs PyTorch (extra `learn`), which `import dase` alone does not load.
"""

from __future__ import annotations

from dase.tasks.checkpoints import load_network as load_network
from dase.tasks.evaluation import Evaluation as Evaluation
from dase.tasks.evaluation import evaluate as evaluate
from dase.tasks.event_networks import E2VidNet as E2VidNet
from dase.tasks.event_networks import EvFlowNet as EvFlowNet
from dase.tasks.event_networks import FireNet as FireNet
from dase.tasks.flow_training import FlowTraining as FlowTraining
from dase.tasks.flow_training import train_flow as train_flow
from dase.tasks.reconstruction_training import ReconstructionTraining as ReconstructionTraining
from dase.tasks.reconstruction_training import train_reconstruction as train_reconstruction
