"""Simulation in MJX: control steps, observations, drivetrains, the interface of residuals, and derivatives."""
