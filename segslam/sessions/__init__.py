"""Finished runs and new recordings in one frame: several runs merged, and a recording localised in an old run."""
