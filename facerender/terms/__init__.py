"""The specular terms: lobes, Fresnel and masking terms, models, each one entry of a registry."""
