"""Export of policies to the robot's own computer."""
