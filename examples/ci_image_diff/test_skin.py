"""Compare images with their goldens in goldens/. After an intended change:

pytest --facerender-update
"""

import os

import pytest
from skin import Skin

# Simulates a fault: SKIN_WEIGHT=0.97 pytest
WEIGHT = float(os.environ.get("SKIN_WEIGHT", "1"))


@pytest.fixture(scope="session")
def skin():
    return Skin()


@pytest.mark.parametrize("m", [0.15, 0.3, 0.6])
def test_highlight(skin, facerender_snapshot, m):
    facerender_snapshot.check(skin.draw(m, WEIGHT), metadata=skin.facts)
