"""A Mitsuba 3 scene as a source: XML -> merged mesh, material truth, camera path, rendered photographs.

`document` (which files belong to a scene) -> `scene` (load, list shapes) -> `flatten` (one mesh) -> `materials`
(albedo, roughness, metallic of a BSDF) -> `path` (where a camera can stand) -> `render` (photographs).
"""
