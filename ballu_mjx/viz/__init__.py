"""Figures, reports, videos and live views of runs."""
