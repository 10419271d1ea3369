"""What losses ask of their windows."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.utils import NestedKey


def check_windows(tensordict: TensorDictBase, steps: int = 1, masks: tuple[NestedKey, ...] = ()) -> None:
    """Check that a TensorDict holds windows ``[B, T]`` of one episode each.

    Args:
        tensordict: input of a loss.
        steps: smallest T.
        masks: keys of masks that are false for invalid steps, as after the end of a padded episode.

    Raises:
        ValueError: there are more or fewer batch axes, too few steps, ``is_init`` after a first step, or valid steps after
            ``("next", "done")``.
    """
    if not tensordict.ndim:  # a loss was called with tensors
        tensordict.auto_batch_size_(2)
    shape = list(tensordict.shape)
    if len(shape) != 2 or shape[1] < steps:
        raise ValueError(
            f"a loss needs windows [B, T] with T of at least {steps}, got {shape}; sample.reshape(-1, T) makes them of a "
            "flat sample of slices"
        )
    begins = tensordict.get("is_init", None)
    if begins is not None and begins[:, 1:].any():
        raise ValueError("a window must lie in one episode, but is_init is true after its first step")
    done = tensordict.get(("next", "done"), None)
    if done is not None:
        goes_on = done.reshape(*shape, -1)[:, :-1].any(-1)
        for key in masks:
            if (mask := tensordict.get(key, None)) is not None:
                goes_on = goes_on & mask.reshape(*shape, -1)[:, 1:].any(-1)
        if goes_on.any():
            raise ValueError(
                'a window must lie in one episode, but ("next", "done") is true before its last step; draw windows '
                "with TorchRL's SliceSampler"
            )
