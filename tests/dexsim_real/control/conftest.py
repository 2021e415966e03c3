"""What tests of the control share."""

import pytest
from test_safety import ready


@pytest.fixture
def bench(hand):
    return ready(hand)
