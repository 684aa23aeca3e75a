"""A cheaper frame of a scene within an error budget: what may be chosen, how it errs, the search,
what it takes."""
