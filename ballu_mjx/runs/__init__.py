"""A run: its folder, checkpoints, metrics and what it shows on the terminal."""
