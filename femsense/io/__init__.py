"""Files: robots, recordings, clouds, meshes, results."""
