"""The map of a run: clean clouds, pictures and grids, from keyframes of any number."""
