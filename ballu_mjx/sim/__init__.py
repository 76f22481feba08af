"""MJX: states in, states and observations out."""
