"""Cost of shading. A plan compares hundreds of shadings, far more than it can time, so a shading is
priced as the sum of its parts: ``table`` maps a scene and a shading to a price per fragment.

Prices come from ``prices.json``, which ``python -m benchmarks.prices table`` writes, or from
measurements on this machine, which ``cost`` makes. All prices of one table have one unit and one
origin: only their ratios have a meaning, and prices of two tables are never mixed."""
