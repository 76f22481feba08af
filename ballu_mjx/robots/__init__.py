"""What a robot is: an MJCF model and a description of what is measured and driven."""
