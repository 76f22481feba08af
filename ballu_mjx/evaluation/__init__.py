"""Stage 5: evaluation of a simulator's predictions and of a policy's transfer to the robot."""
