"""Ways to fail, and which methods do: the table of `rts.diagnostics.stability`."""
