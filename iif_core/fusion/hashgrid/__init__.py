"""Multi-resolution hash-grid texture: 32 levels of trilinear features and a small network (METHOD 2.3.5, H6-H8).

u in [0, 1]^3 -> features of every level -> ReLU network -> raw outputs; what they mean (sigmoids, ranges) is the
solver's matter, in float32 (H6). Two backends give the same numbers up to rounding:

* "numba", CPU: a level belongs to one thread, a batch is visited in Morton order, gradients of the table live only
  from scatter to update of one level, in cache;
* "torch", any device.

Importing this package loads neither torch nor numba.
"""
