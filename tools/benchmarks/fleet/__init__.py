"""Fleets of simulated drives: accuracy and cost as they grow, and what is left of them when processes die."""
