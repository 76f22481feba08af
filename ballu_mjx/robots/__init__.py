"""Robots: MJCF models, and descriptions of their measured and actuated parts."""
