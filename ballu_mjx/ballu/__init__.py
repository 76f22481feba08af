"""BALLU: what only this robot has."""
