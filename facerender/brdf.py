"""Public API of the BRDFs in float64: models, Fresnel and masking terms, sampling, slope variance.

``brdf.NAME`` is ``fr_NAME`` in GLSL, with the same arguments in the same order; see ``terms/``.
A value outside its stated range raises InputError."""

from facerender.terms.environment import cook_torrance_albedo as cook_torrance_albedo
from facerender.terms.environment import cook_torrance_albedo_mean as cook_torrance_albedo_mean
from facerender.terms.environment import cook_torrance_pdf as cook_torrance_pdf
from facerender.terms.environment import cook_torrance_sample as cook_torrance_sample
from facerender.terms.environment import diffuse_coupled as diffuse_coupled
from facerender.terms.environment import environment_cook_torrance as environment_cook_torrance
from facerender.terms.environment import environment_irradiance as environment_irradiance
from facerender.terms.environment import environment_radiance as environment_radiance
from facerender.terms.environment import environment_ward as environment_ward
from facerender.terms.environment import slope_sample as slope_sample
from facerender.terms.environment import ward_pdf as ward_pdf
from facerender.terms.environment import ward_sample as ward_sample
from facerender.terms.model import K_COOK_TORRANCE as K_COOK_TORRANCE
from facerender.terms.model import K_WARD as K_WARD
from facerender.terms.model import MIN_COSINE as MIN_COSINE
from facerender.terms.model import cook_torrance as cook_torrance
from facerender.terms.model import cook_torrance_two as cook_torrance_two
from facerender.terms.model import cosine_disc as cosine_disc
from facerender.terms.model import fresnel as fresnel
from facerender.terms.model import fresnel_dielectric as fresnel_dielectric
from facerender.terms.model import fresnel_schlick as fresnel_schlick
from facerender.terms.model import masking_kelemen as masking_kelemen
from facerender.terms.model import masking_v_cavity as masking_v_cavity
from facerender.terms.model import slope_filtered as slope_filtered
from facerender.terms.model import slope_variance_disc as slope_variance_disc
from facerender.terms.model import slope_variance_map as slope_variance_map
from facerender.terms.model import ward as ward
from facerender.terms.model import ward_printed as ward_printed
