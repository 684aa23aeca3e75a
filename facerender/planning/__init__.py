"""Planning: find a cheaper frame of a scene within an error budget.

``plan`` takes a scene and a budget. ``candidates`` lists the shadings that may replace the full one
and draws views, and ``search`` chooses among them, times frames and explains the choice. Costs
come from ``pricing``.

A shading is accepted only after its error was measured at every pixel of every view: in float64 at
pixel centres, and in OpenGL images if samples, triangles or blended parts matter. Costs only decide
the order of the search: a wrong price makes a plan slower, but never exceeds the budget."""
