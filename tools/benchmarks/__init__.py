"""Benchmarks for the tables of the documentation: `python -m tools.benchmarks.NAME --help` in the root of a checkout."""
