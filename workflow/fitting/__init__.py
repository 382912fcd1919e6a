"""File work of stage `affines`: earlier methods, and textures of cells."""
