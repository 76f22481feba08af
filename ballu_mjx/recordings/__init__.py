"""Stage 1, data: recordings, and their reconstruction as simulator states."""
