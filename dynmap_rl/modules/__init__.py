"""World model and policies: plain ``nn.Module`` building blocks and their TensorDict adapters."""

from .actor import MEMORY, Actor, LatentActor, make_policy_module, make_world_model_module
from .checkpoints import (
    load_policy,
    load_world_model,
    make_policy,
    make_world_model,
    save_policy,
    save_world_model,
)
from .decoder import DYNAMICS, DynamicsDecoder, ImageDecoder
from .encoder import Encoder, SpatialSoftmax
from .normalization import Normalizer
from .policy import FeedforwardPolicy, RecurrentPolicy
from .precision import mixed_precision
from .recurrent import TwoLSTM, delay
from .transition import Transition
from .world_model import WorldModel

__all__ = [
    "Actor",
    "DYNAMICS",
    "DynamicsDecoder",
    "Encoder",
    "FeedforwardPolicy",
    "ImageDecoder",
    "LatentActor",
    "MEMORY",
    "Normalizer",
    "RecurrentPolicy",
    "SpatialSoftmax",
    "Transition",
    "TwoLSTM",
    "WorldModel",
    "delay",
    "load_policy",
    "load_world_model",
    "make_policy",
    "make_policy_module",
    "make_world_model",
    "make_world_model_module",
    "mixed_precision",
    "save_policy",
    "save_world_model",
]
