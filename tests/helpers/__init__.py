"""Shared by several tests: generated drives, logs, networks and places; the run-time type check."""
