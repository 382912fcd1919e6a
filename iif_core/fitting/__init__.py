"""One affine correction per object and the camera response, fitted to the photographs over cached shading (METHOD 2.8, 7b)."""
