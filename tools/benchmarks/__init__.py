"""Benchmarks behind the tables of the documentation: `python -m tools.benchmarks.NAME --help` at the root of a checkout."""
