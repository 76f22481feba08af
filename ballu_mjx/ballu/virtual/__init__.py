"""A virtual BALLU that replaces the hardware."""
