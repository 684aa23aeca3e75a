"""Planning: find a cheaper frame of a scene within an error budget."""
