"""Benchmarks: each module yields the cases that are worth timing."""
