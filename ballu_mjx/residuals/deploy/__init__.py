"""An improved simulator for C MuJoCo."""
