"""Stage 2, actuators: the parts of identification that no robot is needed for."""
