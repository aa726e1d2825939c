import pytest

from hardware import kicad


@pytest.fixture(scope="session")
def tools():
    """KiCad and ngspice, where they can be installed."""
    try:
        return kicad.find()
    except kicad.NoTools as error:
        pytest.skip(str(error))
