"""Planning: find a frame of a scene that costs less to draw, within an error budget."""
