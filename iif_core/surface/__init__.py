"""Surface: triangle meshes, surface cells, segments, and shading cells."""
