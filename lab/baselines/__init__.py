"""Materials of earlier methods over the same cached shading (lab/docs/published.md#earlier-methods-on-the-same-light).

`problem` reduces the pixels of a cell to sums that hold the whole loss, `direct` minimises it by search and `adam` by gradient
descent, both judged by `loss.losses`. `camera` fits the camera response with the albedo of the cells eliminated (IRIS). `stage`
takes the place of stage `affines`.
"""
