"""Export of an improved simulator to C MuJoCo."""
