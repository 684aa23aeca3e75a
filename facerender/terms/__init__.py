"""The registry: each lobe, Fresnel term, masking term and model is one entry, which names its GLSL,
its float64 twin beside it, its domain and its bounds. All that lists terms enumerates it: the
command line, documents, prices, the planner, tests."""

from facerender.terms.fresnel import FRESNEL, Fresnel
from facerender.terms.lobe import LOBES, AnyLobe, GPower, Lobe, lobe_entry
from facerender.terms.masking import MASKING, Masking
from facerender.terms.model import MODELS, Model

__all__ = [
    "FRESNEL",
    "LOBES",
    "MASKING",
    "MODELS",
    "AnyLobe",
    "Fresnel",
    "GPower",
    "Lobe",
    "Masking",
    "Model",
    "lobe_entry",
]
