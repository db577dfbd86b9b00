"""Adjustment of the whole map after the loops: submaps are registered with each other, and all poses are solved."""
