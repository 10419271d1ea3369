import sys

import pytest
import soak


@pytest.mark.skipif(sys.platform != "linux", reason="memory is read as Linux tells it")
def test_worlds_that_are_gone_hold_no_memory():
    """The million steps are ``python tests/soak.py``."""
    result = soak.soak(20_000)
    assert result["episodes"] > 300
    assert result["growth_mb"] < soak.GROWTH_MB
