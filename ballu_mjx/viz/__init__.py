"""Figures, pages, videos and live views of runs."""
