"""Multi-resolution hash-grid texture: levels of trilinear features and a small network (docs/method/fusion.md#hash-grid).

A point u in [0, 1]^3 gives features of every level, which a ReLU network maps to raw outputs in float32; the solver decides
what they mean (docs/method/numerics.md#sigmoid-in-half-precision). Each level is worked on by one thread, a batch is visited
in Morton order, and gradients of the table exist only between scatter and update of one level, in cache.
"""
