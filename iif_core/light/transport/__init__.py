"""Light transport on one merged triangle mesh: Dr.Jit kernels behind functions that take and return NumPy
arrays.

Call `native.prepare()` and `mitsuba.set_variant("llvm_ad_rgb")` before the first `build_geometry`. Every
result is the same to the last bit for the same input and seed, whatever the number of threads and the chunk
size: one lane owns one point, loops over its samples itself, and draws from its own random stream.
"""
