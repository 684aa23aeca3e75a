"""The measurements of ``facerender measure``: cost and error of each specular term, which users
weigh when they choose a lobe for their machine and roughness.

``measurement`` draws a mesh with each variant of a term and returns the content of measure.json as
plain data. ``report`` ranks the variants by cost and error, and writes JSON, images and page. All
variants of a model are timed in turns within one process: times of different runs are never
compared."""
