"""The sampler that peels depths by OpenGL."""
