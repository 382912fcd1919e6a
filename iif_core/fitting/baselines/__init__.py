"""Materials of earlier methods on the same cached shading: a free BRDF in every surface cell (METHOD 6.2, 6.3).

Where our method gives an object sixteen numbers, FIPT and IRIS give every surface point five. `problem` reduces the pixels
of a cell to sums that hold the whole loss, `direct` minimises it exactly per cell, `adam` as the publications do, both
judged by `loss.losses`; `camera` fits the camera response with the cells' albedo eliminated (IRIS).
"""
