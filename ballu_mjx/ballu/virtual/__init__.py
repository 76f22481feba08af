"""A virtual BALLU that stands in for the hardware."""
