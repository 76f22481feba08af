"""Stage 3, residual forces: what the simulator lacks, learned or identified."""
