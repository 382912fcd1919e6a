"""Surface: triangle meshes, surface cells, segments, shading cells."""
