"""Light transport on one triangle mesh: Dr.Jit kernels behind functions that take and return NumPy arrays.

Modules: `geometry` (mesh and rays), `materials`, `emitters`, `cache` (radiance cache), `scene` (what paths meet, and how many
are traced), `kernels` (one path), and the three estimators `render`, `shading` and `matrix` (docs/method/shading.md,
docs/method/light.md#transport-matrix).

Call `workflow.runtime.native.prepare()` and `mitsuba.set_variant("llvm_ad_rgb")` before the first `build_geometry`. Results
are the same to the last bit for the same input and seed, whatever the number of threads and the chunk size: a lane works on
one point, loops over its samples itself, and draws from a random stream of its own.
"""
