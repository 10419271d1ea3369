"""bfloat16 where it is fast."""

from __future__ import annotations

import torch


def mixed_precision(device: torch.device | str) -> torch.autocast:
    """bfloat16 where the processor computes with it: a recurrent policy's update takes a third of the time."""
    kind = torch.device(device).type
    fast = kind != "cpu" or (
        torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()
    )
    # No cache of cast weights: threads would share it, and no weight is used twice.
    return torch.autocast(kind, torch.bfloat16, enabled=fast, cache_enabled=False)
