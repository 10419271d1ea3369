"""Weights as safetensors: a file from elsewhere runs no code, and its weights take memory in proportion to its size."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import load_file, save
from torch import nn

from .files import write_bytes


def save_weights(path: Path, module: nn.Module) -> None:
    """Write a module's state as safetensors, atomically."""
    # Clones, as two names of one tensor are refused.
    state = {name: value.detach().cpu().contiguous().clone() for name, value in module.state_dict().items()}
    write_bytes(path, save(state))


def load_module[Module: nn.Module](path: Path, make: Callable[[], Module]) -> Module:
    """Make a module and load the weights of a safetensors file into it.

    The names and shapes of the file are compared with the module's before anything is allocated, since a file from
    elsewhere may name any size.

    Args:
        path: file of the weights.
        make: function that makes the module.

    Raises:
        ValueError: the file is missing, damaged, or does not fit the module.
    """
    if not Path(path).exists():
        raise ValueError(f"no weights at {path}")
    try:
        with torch.device("meta"):
            shapes = {name: list(value.shape) for name, value in make().state_dict().items()}
        with safe_open(path, "pt") as file:
            found = {name: file.get_slice(name).get_shape() for name in file.keys()}
        if found != shapes:
            differing = sorted(k for k in {*found, *shapes} if found.get(k) != shapes.get(k))
            raise ValueError(f"other names or shapes, such as {differing[0]}")
        module = make()
        module.load_state_dict(load_file(path))
    except OSError:
        raise
    except Exception as error:  # torch on impossible sizes, safetensors on damaged files
        raise ValueError(
            f"{path} and arguments.json beside it do not belong together or are damaged ({error}); download them again, or "
            "train again"
        ) from error
    return module


def fingerprint(module: nn.Module) -> str:
    """Return the SHA-256 of all weights and buffers; it is equal before and after where nothing has changed."""
    digest = hashlib.sha256()
    for name, value in sorted(module.state_dict().items()):
        digest.update(name.encode())
        digest.update(value.cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
