"""The built-in shaders, textures, and what shaders read of samples."""
