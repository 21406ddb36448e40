"""The command `rts`."""
