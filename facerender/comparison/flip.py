"""FLIP (Andersson et al. 2020): what an eye sees of a difference when two images alternate. No
other module imports flip_evaluator."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError

Image = NDArray[np.floating]


def errors(reference: Image, image: Image) -> NDArray[np.float64]:
    """Return the error of each pixel (H, W), in [0, 1]; its mean is FLIP of the image.

    Parameters
    ----------
    reference, image : (H, W, 3), sRGB in [0, 1]

    Raises
    ------
    InputError : the package flip-evaluator is missing
    """
    return np.asarray(_evaluate(reference, image, magma=False)[..., 0], dtype=np.float64)


def heat_map(reference: Image, image: Image) -> NDArray[np.uint8]:
    """Return the errors as 8-bit colours (H, W, 3), from black through red to pale yellow;
    parameters and what is raised as in :func:`errors`."""
    colors = _evaluate(reference, image, magma=True)
    return np.asarray(np.round(255.0 * colors.clip(0.0, 1.0)), dtype=np.uint8)


def _evaluate(reference: Image, image: Image, magma: bool) -> Any:
    try:
        from flip_evaluator import evaluate
    except ImportError:
        raise InputError("FLIP needs pip install 'facerender[measure]'") from None
    images = (each.astype(np.float32) for each in (reference, image))
    return evaluate(*images, "LDR", applyMagma=magma, computeMeanError=False)[0]
