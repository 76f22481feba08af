"""Residuals (stage 3): learned or identified forces, model fields and command changes that correct the simulator."""
