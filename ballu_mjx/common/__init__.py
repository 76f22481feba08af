"""Foundations of the package, independent of any robot: errors, files, rotations, results and start-up."""
