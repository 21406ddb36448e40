"""Elements of a scene: parts, cameras, poses, and tables of triangles."""
