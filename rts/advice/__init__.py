"""Warnings of a render: images in which nothing is seen, entries that nothing reads, parts wound inside out."""
