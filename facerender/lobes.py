"""Public API of the lobes in float64: E/c^k, its approximations and their domains.

The lobe ``lobes.NAME`` is ``fr_lobe_NAME`` in GLSL; see ``terms/lobe.py``. A value outside its
stated range raises InputError."""

from facerender.terms.lobe import FITTED as FITTED
from facerender.terms.lobe import LOBES as LOBES
from facerender.terms.lobe import MAX_SLOPE as MAX_SLOPE
from facerender.terms.lobe import MIN_SLOPE as MIN_SLOPE
from facerender.terms.lobe import AnyLobe as AnyLobe
from facerender.terms.lobe import GPower as GPower
from facerender.terms.lobe import PowerPolynomial as PowerPolynomial
from facerender.terms.lobe import check_slope as check_slope
from facerender.terms.lobe import clamped_power as clamped_power
from facerender.terms.lobe import cosine as cosine
from facerender.terms.lobe import exact as exact
from facerender.terms.lobe import exact_tan2 as exact_tan2
from facerender.terms.lobe import fitted as fitted
from facerender.terms.lobe import fitted_coefficients as fitted_coefficients
from facerender.terms.lobe import fitted_fine as fitted_fine
from facerender.terms.lobe import fitted_fine_coefficients as fitted_fine_coefficients
from facerender.terms.lobe import g_power as g_power
from facerender.terms.lobe import in_domain as in_domain
from facerender.terms.lobe import lobe as lobe
from facerender.terms.lobe import max_slope as max_slope

NAMES = tuple(LOBES)
