"""Fitting materials to the photographs over cached shading (Eq. M.1, M.14; docs/method/fitting.md).

`direct.fit_affines` fits one affine map for each object and the camera response; `sgd` is the paper's optimiser for the same
`problem`. `gauge` settles the level of all albedos, and `baselines` fits the material models of earlier methods.
"""
