"""Light transport on one merged triangle mesh: Dr.Jit kernels behind functions that take and return NumPy
arrays.

Call `native.prepare()` and `mitsuba.set_variant("llvm_ad_rgb")` before the first `build_geometry`. Every
result is the same to the last bit for the same input and seed, whatever the number of threads and the chunk
size: one lane owns one point, loops over its samples itself, and draws from its own random stream.
"""

from .cache import RadianceCache
from .emitters import Emitters
from .geometry import Geometry, build_geometry, cosine_directions, trace
from .materials import CellMaterials, FaceMaterials
from .matrix import transport_matrix
from .render import first_hits, render
from .shading import shading_caches

__all__ = [
    "CellMaterials",
    "Emitters",
    "FaceMaterials",
    "Geometry",
    "RadianceCache",
    "build_geometry",
    "cosine_directions",
    "first_hits",
    "render",
    "shading_caches",
    "trace",
    "transport_matrix",
]
