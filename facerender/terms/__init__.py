"""Registry of lobes, Fresnel terms, masking terms and models.

Each entry contains the GLSL call, float64 reference, domain and error bounds of a term. The command
line, the documents, the prices, the planner and the tests enumerate the entries."""

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
