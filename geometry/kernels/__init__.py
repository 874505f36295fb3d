"""Compiled kernels: arrays and scalars only. Each has a slow numpy twin in the tests."""
