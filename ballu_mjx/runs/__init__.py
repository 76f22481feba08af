"""A run: its folder, checkpoints, metrics, and progress on the terminal."""
