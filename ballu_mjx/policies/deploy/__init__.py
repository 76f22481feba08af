"""A policy on the robot's own computer."""
