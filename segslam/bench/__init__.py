"""Simulated worlds, and the experiments of the paper."""
