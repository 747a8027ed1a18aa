"""Benchmarks: each module yields cases to be timed."""
