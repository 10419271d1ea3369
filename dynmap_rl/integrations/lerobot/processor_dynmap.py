"""What stands before and behind the policy ``dynmap``: names, batches and devices, and no normalisation."""

from __future__ import annotations

from lerobot.processor.factory import make_default_pre_post_processors

from .configuration_dynmap import DynmapConfig


def make_dynmap_pre_post_processors(config: DynmapConfig, dataset_stats: dict | None = None):
    """LeRobot's usual steps. The policy normalises by constants in its own weights, so the statistics are not kept."""
    return make_default_pre_post_processors(config)
