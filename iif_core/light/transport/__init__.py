"""Light transport on one triangle mesh: Dr.Jit kernels behind functions that take and return NumPy arrays.

Call `workflow.runtime.native.prepare()` and `mitsuba.set_variant("llvm_ad_rgb")` before the first `build_geometry`. Results
are the same to the last bit for the same input and seed, whatever the number of threads and the chunk size.
"""
