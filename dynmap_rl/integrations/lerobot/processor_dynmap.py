"""Processors of the policy ``dynmap``: names, batches and devices, without normalisation."""

from __future__ import annotations

from lerobot.processor.factory import make_default_pre_post_processors

from .configuration_dynmap import DynmapConfig


def make_dynmap_pre_post_processors(config: DynmapConfig, dataset_stats: dict | None = None):
    """Make LeRobot's default processors; the policy normalises by constants of its own.

    Args:
        config: settings of the policy.
        dataset_stats: not used.
    """
    return make_default_pre_post_processors(config)
