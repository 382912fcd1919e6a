"""Light transport on one triangle mesh: Dr.Jit kernels behind functions that take and return NumPy arrays.

The caller chooses Mitsuba's variant, `llvm_ad_rgb` or `cuda_ad_rgb`, before these modules are imported
(`workflow.runtime.device`). On a CPU results are the same to the last bit for the same input and seed, whatever the number of
threads and the chunk size.
"""
