"""Memory over many episodes; ``python tests/stress/soak.py`` runs a million steps."""

import sys

import pytest
from stress import soak


@pytest.mark.stress
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory_does_not_grow():
    result = soak.soak(20_000)
    assert result["episodes"] > 300
    assert result["growth_mb"] < soak.GROWTH_MB
