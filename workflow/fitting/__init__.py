"""File work of stage `affines`: material models of earlier methods, and textures of cells."""
