"""Code for BALLU alone: its model, legs, actuators, gaits, recordings and the virtual robot."""
