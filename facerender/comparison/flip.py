"""FLIP (Andersson et al. 2020): the difference that an observer sees when two images alternate.

Only this module imports flip_evaluator.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError

Image = NDArray[np.floating]

PPD = 67.0206  # pixels per degree: 3840 pixels on 0.7 m, viewed from 0.7 m


def errors(reference: Image, image: Image) -> NDArray[np.float64]:
    """Return the error of each pixel (H, W), in [0, 1]; its mean is the FLIP value of the image.

    Parameters
    ----------
    reference, image : (H, W, 3), sRGB in [0, 1]

    Raise InputError if the package flip-evaluator is missing.
    """
    return np.asarray(_evaluate(reference, image, magma=False)[..., 0], dtype=np.float64)


def heat_map(reference: Image, image: Image, step: int = 1) -> NDArray[np.uint8]:
    """Return the errors as 8-bit colours (H, W, 3), from black through red to pale yellow.

    Parameters and errors are as in :func:`errors`.

    step : N if the images contain every Nth pixel of larger images; FLIP then treats each pixel as
        N pixels wide
    """
    colors = _evaluate(reference, image, magma=True, **({"ppd": PPD / step} if step > 1 else {}))
    return np.asarray(np.round(255.0 * colors.clip(0.0, 1.0)), dtype=np.uint8)


def check_installed() -> None:
    """Raise InputError if the package flip-evaluator is missing."""
    if find_spec("flip_evaluator") is None:
        raise InputError("FLIP needs pip install 'facerender[measure]'")


def _evaluate(reference: Image, image: Image, magma: bool, **parameters: float) -> Any:
    check_installed()
    from flip_evaluator import evaluate

    images = (pixels.astype(np.float32) for pixels in (reference, image))
    options = {"applyMagma": magma, "computeMeanError": False, "parameters": parameters}
    return evaluate(*images, "LDR", **options)[0]
