"""Mixed precision where the processor supports it."""

from __future__ import annotations

import torch


def mixed_precision(device: torch.device | str) -> torch.autocast:
    """Return an autocast to bfloat16, enabled where the device computes in bfloat16.

    Processors with AVX-512 but without its bfloat16 instructions emulate them, which takes three times as long as
    float32. GPUs before Ampere emulate them too.
    """
    kind = torch.device(device).type
    fast = True
    if kind == "cpu":
        fast = torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    elif kind == "cuda":
        fast = torch.cuda.is_bf16_supported(including_emulation=False)
    # A cache of cast weights is of no use, as no weight is used twice.
    return torch.autocast(kind, torch.bfloat16, enabled=fast, cache_enabled=False)
