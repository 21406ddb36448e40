"""Ways to fail, and which methods do: the table of `rts_compare.stability`."""
