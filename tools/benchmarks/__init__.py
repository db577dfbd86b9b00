"""Benchmarks for the tables in the documentation: `python -m tools.benchmarks.NAME --help` in the root folder."""
