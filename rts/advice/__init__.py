"""What a render warns of: images in which nothing is seen, entries that nothing reads, parts wound inside out."""
