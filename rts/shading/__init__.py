"""The built-in shaders, textures, and the attributes and entries of θ that shaders read."""
