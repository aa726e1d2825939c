"""What the recorder's tests share."""

import pytest
from record_box import Lab


@pytest.fixture
def lab():
    return Lab()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "s.mcap"
