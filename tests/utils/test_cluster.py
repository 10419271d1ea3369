"""Calls on Ray's workers."""

import os
import sys

import pytest

from dynmap_rl.utils.cluster import run_by_ray


@pytest.mark.slow
def test_workers_have_the_environment_and_folder_of_the_command_and_raise_its_errors(ray):
    pytest.importorskip("torchrl.envs")  # imports Ray, which reads its settings then

    def describe(number):
        if number == 2:
            raise ValueError("two")
        return number, sys.prefix, os.getcwd()

    results = dict(run_by_ray(describe, [0, 1, 2]))
    for number in (0, 1):
        assert results[number]() == (number, sys.prefix, os.getcwd())
    with pytest.raises(ValueError, match="two"):
        results[2]()
