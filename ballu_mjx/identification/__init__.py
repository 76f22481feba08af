"""Stage 2, actuators: identification code that is not specific to one robot."""
