"""Objects: graph segmentation of a mesh, and consensus of 2D masks."""
