"""Improved simulators as environments of other libraries."""
