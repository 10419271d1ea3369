"""Memory of actors in TensorDicts: read where it is, zero where an episode begins, written under ``next``."""

from __future__ import annotations

import warnings
from collections.abc import Iterable

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.data import Composite, Unbounded
from torchrl.envs import TensorDictPrimer
from torchrl.modules import recurrent_mode


def find(tensordict: TensorDictBase, key: NestedKey) -> torch.Tensor | TensorDictBase | None:
    """Return an entry, or None where it is absent.

    ``torch.compile`` compiles again where the keys have changed, which it does not notice of ``get`` with a default.
    """
    return tensordict[key] if unravel_key(key) in tensordict.keys(include_nested=True) else None


def recall(tensordict: TensorDictBase, sizes: dict, is_init: NestedKey, device) -> tuple[torch.Tensor, ...]:
    """Return the entries of ``sizes``; zeros where an episode begins, and where they and ``is_init`` are absent."""
    batch, begins = tensordict.batch_size, find(tensordict, is_init)
    # [B] would be broadcast over the entries of a memory where their number is B.
    if begins is not None and begins.shape != (*batch, 1):
        raise ValueError(f"{is_init} must be of shape {[*batch, 1]}, got {list(begins.shape)}")
    check_memory(tensordict, sizes, begins)
    found = {key: find(tensordict, key) for key in sizes}
    state = [
        torch.zeros(*batch, n, device=device) if found[k] is None else found[k] for k, n in sizes.items()
    ]
    return tuple(state if begins is None else (s.masked_fill(begins, 0.0) for s in state))


def check_memory(tensordict: TensorDictBase, keys: Iterable[NestedKey], begins: torch.Tensor | None) -> None:
    """Check that memory is there, except where episodes begin, and that the call is of one time step.

    Raises:
        KeyError: the environment does not pass the memory on.
        RuntimeError: TorchRL's recurrent mode is on, in which modules read whole windows.
    """
    if recurrent_mode():
        raise RuntimeError(
            "an actor reads one time step; windows are for make_world_model_module and make_policy_module"
        )
    missing = [key for key in keys if find(tensordict, key) is None]
    if missing and begins is not None and not begins.all():
        raise KeyError(
            f"{missing[0]} is missing after the first step; append actor.make_tensordict_primer() to the environment"
        )


def warn_without_memory(
    actor: TensorDictModuleBase, tensordict: TensorDictBase, keys: Iterable[NestedKey]
) -> None:
    """Warn if neither memory nor the start of episodes is there in two calls in a row, as in an environment without both."""
    blind = any(find(tensordict, key) is None for key in keys) and find(tensordict, actor.is_init) is None
    if blind and actor.blind:
        warnings.warn(
            "the actor had no memory in two calls in a row; append InitTracker() and actor.make_tensordict_primer() to the "
            "environment, or pass on what is written under next",
            stacklevel=3,
        )
    actor.blind = blind


def remember(tensordict: TensorDictBase, keys, values) -> None:
    """Write values under ``next``."""
    for key, value in zip(keys, values, strict=True):
        tensordict.set(unravel_key(("next", key)), value)


def make_primer(sizes: dict[NestedKey, int]) -> TensorDictPrimer:
    """Make the transform that gives an environment entries of these sizes, zero at every reset."""
    specs = Composite()
    for key, size in sizes.items():
        specs[key] = Unbounded((size,))
    return TensorDictPrimer(specs, default_value=0.0, expand_specs=True)
