"""What a scene is made of: parts, cameras, poses, and tables of triangles."""
