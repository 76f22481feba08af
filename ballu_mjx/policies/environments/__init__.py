"""Improved simulators as environments for other libraries."""
