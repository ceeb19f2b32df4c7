"""Metrics, data-set readers and baselines: everything that judges a reconstruction."""
