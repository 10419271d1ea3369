"""Mixed precision where the processor supports it."""

from __future__ import annotations

import torch


def mixed_precision(device: torch.device | str) -> torch.autocast:
    """Return an autocast to bfloat16, enabled where the device computes in bfloat16."""
    kind = torch.device(device).type
    fast = kind != "cpu" or (
        torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()
    )
    # Threads would share a cache of cast weights, and no weight is used twice.
    return torch.autocast(kind, torch.bfloat16, enabled=fast, cache_enabled=False)
